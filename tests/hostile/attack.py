"""What an attack is, and what it means that it was handled.

Owns: `Attack`, `HostileClass`, `Unhandled`, and the checks that every class shares. Handled means:
a documented exit code, never 70; where it failed, a reason in words; no traceback and no control
characters in any output; ended within its bound; no process, shared memory or run directory left.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import io
import os
import random
import re
import signal
import subprocess
import sys
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import psutil

from lifecycle.cli import main
from lifecycle.errors import ExitCode
from tests.ros.supervisor.running import ROOT, environment, left_of, marked

BOUND_S = 30.0
"""Far above what any attacked command takes; an attack that needs longer names its bound."""

CODES = frozenset({*map(int, ExitCode)} - {ExitCode.INTERNAL})
_COLOUR = re.compile(r"\x1b\[[0-9;]*m")
_FAST_DDS = re.compile(r"^\x1b\[37;1m\d{4}-.*$", re.MULTILINE)
_CONTROL = frozenset(map(chr, (*range(9), *range(11, 32), *range(127, 160), 0x202E)))


class Unhandled(Exception):  # noqa: N818 - what an attack that succeeded is called here
    """An attack was not handled; the message says what happened instead."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Place:
    """Where the attacks of one class run.

    Attributes:
        path: empty folder of its own.
        domain: ROS domain of its own, in the environment too.
        random: seeded.
    """

    path: Path
    domain: int
    random: random.Random

    def folder(self) -> Path:
        """Return a new folder; paths of control sockets are short."""
        made = self.path / uuid.uuid4().hex[:8]
        made.mkdir(mode=0o700)
        return made


@dataclasses.dataclass(frozen=True, kw_only=True)
class Attack:
    """One attack.

    Attributes:
        name: unique in its class, the same for the same seed.
        run: raises Unhandled, or any other error, if it was not handled. It is given what the
            class's stage yields.
    """

    name: str
    run: Callable[[Any], None]


class Attacks(list[Attack]):
    """Attacks of one class while they are made."""

    def add(self, name: str, function: Callable[..., None], *arguments: object) -> None:
        self.append(Attack(name=name, run=functools.partial(function, *arguments)))


def _bare(place: Place, attacks: Sequence[Attack]) -> AbstractContextManager[Any]:
    return contextlib.nullcontext(place)


@dataclasses.dataclass(frozen=True, kw_only=True)
class HostileClass:
    """Attacks of one kind.

    Attributes:
        name: for `--class`.
        attacks: makes them; equal for equal seeds.
        stage: a context that they share, a running system, say; it is given those that were chosen.
        limit_s: seconds for the whole class.
        has_host: with root it runs on a host of its own, whose address is HOSTILE_HOST.
    """

    name: str
    attacks: Callable[[random.Random], list[Attack]]
    stage: Callable[[Place, Sequence[Attack]], AbstractContextManager[Any]] = _bare
    limit_s: float = 240.0
    has_host: bool = False


@dataclasses.dataclass(frozen=True, kw_only=True)
class Done:
    """How a command ended."""

    code: int
    out: str
    err: str


def check_text(*texts: str) -> None:
    """Raise Unhandled for what must be in no output."""
    for coloured in texts:
        # Fast DDS colours its own messages; nobody else's texts are in those.
        text = _FAST_DDS.sub(lambda line: _COLOUR.sub("", line[0]), coloured)
        for word in ("Traceback (most recent call last)", "this is a bug in lifecycle"):
            if word in text:
                raise Unhandled(f"it says {word!r}: …{text[-1500:]}")
        if found := sorted(set(text) & _CONTROL):
            raise Unhandled(f"control characters {found!r} in {text[:300]!r}")


def check(done: Done, *allowed: int) -> None:
    """Raise Unhandled unless a command ended as documented, with a reason where it failed."""
    check_text(done.out, done.err)
    if done.code not in (allowed or CODES):
        raise Unhandled(f"exit code {done.code}; {done.out[-300:]!r} {done.err[-1000:]!r}")
    if done.code and not (done.out + done.err).strip():
        raise Unhandled(f"exit code {done.code} without a word")


class _TooLate(BaseException):
    """Not an Exception: nothing of the package may swallow it."""


def in_process(
    *words: str, variables: Mapping[str, str] | None = None, limit_s: float = 6.0
) -> Done:
    """Run a verb that needs no ROS in this process, in the main thread."""
    out, err = io.StringIO(), io.StringIO()
    before = dict(os.environ)

    def late(*_: object) -> None:
        raise _TooLate

    os.environ.update(variables or {})
    previous = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, limit_s)
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = main(list(words))
    except _TooLate:
        raise Unhandled(f"still running after {limit_s:g} s") from None
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, previous)
        os.environ.clear()
        os.environ.update(before)
    return Done(code=int(code), out=out.getvalue(), err=err.getvalue())


@contextlib.contextmanager
def started(
    *words: str,
    runtime: Path,
    through: Sequence[str] = (),
    variables: Mapping[str, str] | None = None,
    **options: Any,
) -> Iterator[tuple[subprocess.Popen[bytes], str]]:
    """Start a verb in a process of its own; yield it and its mark, and end whatever it left."""
    mark = uuid.uuid4().hex
    process = subprocess.Popen(
        [*through, sys.executable, "-m", "lifecycle", *words],
        cwd=ROOT,
        env={**environment(runtime, mark), **(variables or {})},
        start_new_session=True,
        **{
            "stdin": subprocess.DEVNULL,
            "stdout": subprocess.PIPE,
            "stderr": subprocess.PIPE,
            **options,
        },
    )
    try:
        yield process, mark
    finally:
        for each in marked(mark):
            with contextlib.suppress(psutil.NoSuchProcess):
                each.kill()
        process.communicate()


def ended(process: subprocess.Popen[bytes], mark: str, runtime: Path, *, limit_s: float) -> Done:
    """Wait until a process ends within its bound, and check that nothing of it is left."""
    try:
        out, err = process.communicate(timeout=limit_s)
    except subprocess.TimeoutExpired:
        raise Unhandled(f"still running after {limit_s:g} s") from None
    if left := left_of(mark, within_s=2.0):
        raise Unhandled(f"it left processes: {left}")
    runs = runtime / "lifecycle"
    if runs.is_dir() and any(runs.iterdir()):
        raise Unhandled(f"it left {[str(each) for each in runs.rglob('*')]}")
    return Done(
        code=process.returncode,
        out=(out or b"").decode(errors="replace"),
        err=(err or b"").decode(errors="replace"),
    )


def in_a_process(*words: str, runtime: Path, limit_s: float = BOUND_S, **options: Any) -> Done:
    """Run a verb to its end in a process of its own; it leaves nothing."""
    with started(*words, runtime=runtime, **options) as (process, mark):
        done = ended(process, mark, runtime, limit_s=limit_s)
    check_text(done.out, done.err)
    return done


def mutated(data: bytes, rng: random.Random) -> bytes:
    """Return `data` with a few bytes, words or pieces of it changed."""
    changed = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(len(changed) + 1)
        to = min(len(changed), at + rng.randint(0, 12))
        match rng.randrange(6):
            case 0:
                changed[at:to] = rng.randbytes(rng.randint(0, 8))
            case 1:
                changed[at:to] = rng.choice(_WORDS)
            case 2:
                del changed[at:to]
            case 3:
                changed[at:at] = changed[at:to] * rng.choice((1, 2, 500))
            case 4:
                del changed[at:]
            case _:
                changed[at:at] = rng.choice((b"[", b"{", b'"', b"(", b"<")) * rng.choice((1, 3000))
    return bytes(changed)


_WORDS = (
    *(b"null", b"true", b"-1", b"0", b"1e999", b"NaN", b"9" * 400, b"2147483648", b"0x41"),
    *(b'""', b"[]", b"{}", b'"\\ud800"', b"\\u0000", b"\x1b[2J", b"\n", b"\0", b"\xff\xfe"),
    *("\u202e".encode(), b"../../etc/passwd", b"$(env HOME)", b"$(arg x)", b"*a", b"&a ", b"!!x "),
)
