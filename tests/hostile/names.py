"""Names of topics and nodes that ROS would refuse, announced by a bare DDS participant.

One active system sees them all; every verb that looks at it runs once, and each name must be in
what the supervisor finds, escaped. The real verbs say what they always say. Names that are no UTF-8
come last: rclpy names one of the topics that have such a name and no other topic then, and of a
topic on which a node has such a name no endpoint, so that one topic is found for each.
"""

from __future__ import annotations

import contextlib
import functools
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from lifecycle.errors import ExitCode
from tests.hostile.attack import (
    Attack,
    Done,
    HostileClass,
    Place,
    Unhandled,
    check,
    check_text,
)
from tests.ros.faults.system import BARE_DDS
from tests.ros.supervisor.running import Up, pair, verb

STRING = b":std_msgs::msg::dds_::String_"
TOPICS = {
    b"foo-bar": "/foo-bar",
    b"foo.bar": "/foo.bar",
    b"foo bar": "/foo bar",
    b"1foo": "/1foo",
    b"f\xffo": "/f\\xffo",
    b"": "/",
    b"/": "//",
    b"a/": "/a/",
    b"a__b": "/a__b",
    b"a\x1b[2Jb": "/a\\x1b[2Jb",
    b"a\nb": "/a\\nb",
    b"a\rb": "/a\\rb",
    b"a\tb": "/a\\tb",
    b"a\xc2\x9b2Jb": "/a\\x9b2Jb",
    b"a\xe2\x80\xaeb": "/a\\u202eb",
    b"[red]b": "/[red]b",
    "é".encode(): "/é",
    b"{x}": "/{x}",
    b"$(x)": "/$(x)",
}
"""Bytes after `rt/` → how they are shown."""

NODES = {
    (b"/", b"foo-bar"): "/foo-bar",
    (b"/", b""): "/",
    (b"/", b"a\x1b[31mb"): "/a\\x1b[31mb",
    (b"/", b"1foo"): "/1foo",
    (b"/", "é".encode()): "/é",
    (b"/", b"\xff\xfe"): "/\\xff\\xfe",
    (b"/", b"x\nverdict: ok"): "/x\\nverdict: ok",
    (b"bad", b"x"): "bad/x",
    (b"/a-b", b"x"): "/a-b/x",
    (b"", b"y"): "/y",
    (b"//", b"z"): "/z",
}
"""Namespace and name → how they are shown."""

MANY = 60
"""Generated names of topics; half as many of nodes."""

PER_PARTICIPANT = 30
WAIT_S = 40.0

VERBS = {
    "verify": (ExitCode.VIOLATED, "/foo-bar"),
    "flows": (ExitCode.VIOLATED, "/chatter"),
    "graph": (ExitCode.OK, "/foo-bar"),
    "status": (ExitCode.VIOLATED, "/talker"),
    "capture": (ExitCode.OK, "node /foo-bar is left out"),
}
"""Verbs that look → exit code, and what they show."""

BLIND = "verify blindly"
"""Where a name of a topic is no UTF-8, from before it looks."""


def raw(name: bytes) -> str:
    return name.decode(errors="backslashreplace")


def _name(rng: random.Random) -> bytes:
    """Return a name that differs from others, without NUL: it would end an argument."""
    pieces = (
        *(
            b"foo",
            b"/",
            b"//",
            b"~",
            b"{",
            b"}",
            b" ",
            b"\n",
            b"\r",
            b"\t",
            b"\x1b[2J",
            b"\x9b",
            b"\x7f",
        ),
        *("\u202e".encode(), "é".encode(), b"\xff", b"\xc0\x80", b"\xed\xa0\x80", b"$(id)", b"%s"),
        *(
            b"'; DROP",
            b"<b>",
            b"]]>",
            b"&amp;",
            b"verdict: ok",
            b"-",
            b"..",
            b"x" * 100,
            b'"',
            b"\\",
        ),
    )
    return b"".join(rng.choice(pieces) for _ in range(rng.randint(1, 6)))


def _of_topic(name: bytes) -> str:
    return "/" + raw(name)


def _of_node(space: bytes, name: bytes) -> str:
    return f"{raw(space).rstrip('/')}/{raw(name)}"


class Named:
    """An attack by one name: of a topic, or a node's namespace and name."""

    def __init__(self, name: tuple[bytes, ...]) -> None:
        self.name = name

    @property
    def shown(self) -> str:
        """How a finding names it."""
        return _of_topic(*self.name) if len(self.name) == 1 else _of_node(*self.name)

    @property
    def legible(self) -> bool:
        """Whether it is UTF-8."""
        with contextlib.suppress(UnicodeDecodeError):
            return all(isinstance(part.decode(), str) for part in self.name)
        return False

    def __call__(self, seen: Seen) -> None:
        if self.legible and self.shown not in seen.subjects:
            raise Unhandled(f"no finding names {self.shown!r}")
        if not self.legible and not seen.illegible[len(self.name)]:
            raise Unhandled(f"no finding says that there is {self.shown!r}")


class Seen:
    """What a supervisor found, and how verbs ended, beside all of the names.

    Attributes:
        illegible: whether it found topics with names that are no UTF-8 (1), and a topic of a node
            with such a name (2).
    """

    def __init__(self) -> None:
        self.subjects: set[str] = set()
        self.illegible: dict[int, bool] = {}
        self.verbs: dict[str, Exception | None] = {}


@contextlib.contextmanager
def stage(place: Place, attacks: Sequence[Attack]) -> Iterator[Seen]:
    folder = place.folder()
    seen = Seen()
    manifest = pair(folder, place.domain)
    run = Up(manifest, runtime=folder)
    intruders = []
    try:
        run.until("system", reached="active")
        every = [each.run for each in attacks if isinstance(each.run, Named)]
        legible = [each for each in every if each.legible]
        topics = [each.name for each in legible if len(each.name) == 1]
        nodes = [each.name for each in legible if len(each.name) == 2]
        for at in range(0, max(len(topics), len(nodes)), PER_PARTICIPANT):
            intruders.append(_intruder(topics[at : at + PER_PARTICIPANT]))
            intruders.append(_intruder(nodes[at : at + PER_PARTICIPANT], at))
        wanted = {each.shown for each in legible}
        _found(run, seen, lambda: not wanted - seen.subjects)
        for each in VERBS:
            seen.verbs[each] = _ended(each, str(manifest), place, folder)
        for length, number in ((2, MANY), (1, 0)):
            names = [each for each in every if not each.legible and len(each.name) == length]
            if not names:
                continue
            intruders.append(_intruder([each.name for each in names], number))
            shown = {each.shown for each in names} if length == 1 else {_topic_of(number)}
            seen.illegible[length] = _found(run, seen, lambda any_=shown: any_ & seen.subjects)
        seen.verbs[BLIND] = _ended(BLIND, str(manifest), place, folder)
        if run.process.poll() is not None:
            raise Unhandled(f"the supervisor ended: {run.events[-2:]}")
        for each in intruders:
            each.kill()
            each.wait()
        yield seen
        run.signal(signal.SIGINT)
        if (code := run.finish()) != ExitCode.INTERRUPTED:
            raise Unhandled(f"the supervisor ended with {code}")
        run.assert_nothing_left()
        check_text(run.said())
    finally:
        for each in intruders:
            each.kill()
            each.wait()
        run.close()


def _intruder(names: Sequence[tuple[bytes, ...]], number: int = 0) -> subprocess.Popen[bytes]:
    """Start a participant that has topics of these names, or nodes that have one topic each."""
    words = [os.fsencode(each) for each in (sys.executable, BARE_DDS)]
    for at, (*space, name) in enumerate(names, number):
        topic = os.fsencode(_topic_of(at)) if space else b"/" + name
        words += [b"--write", b"rt" + topic + STRING]
        words += [b"--node", *space, name] if space else []
    return subprocess.Popen(words, stdout=subprocess.DEVNULL)


def _topic_of(number: int) -> str:
    return f"/foo_baz{number}"


def _found(run: Up, seen: Seen, holds: Callable[[], object]) -> bool:
    """Note what findings name until something holds of it; return whether it does."""
    deadline = time.monotonic() + WAIT_S
    while not holds() and time.monotonic() < deadline:
        run.catch_up()
        for each in run.of_kind("verdict"):
            seen.subjects |= {found["subject"] for found in each["verdict"]["findings"]}
        time.sleep(0.2)
    return bool(holds())


def _ended(name: str, manifest: str, place: Place, runtime: Path) -> Exception | None:
    try:
        _shows(name, manifest, place, runtime)
    except Exception as error:  # noqa: BLE001 - it is what the attack did
        return error
    return None


def _shows(name: str, manifest: str, place: Place, runtime: Path) -> None:
    words = {
        "capture": ("--domain", str(place.domain), "--wait", "1"),
        "graph": (manifest,),
        "status": (manifest,),
        BLIND: (manifest, "--timeout", "4"),  # all have joined by then, whatever else runs
    }.get(name, (manifest, "--timeout", "1"))
    # Who has a publisher cannot be asked then, which is no violation, and not ok either.
    blind = (ExitCode.OK, "unverifiable graph.unattributed-endpoint")
    code, shown = VERBS.get(name, blind)
    done = verb(name.removesuffix(" blindly"), *words, runtime=runtime)
    check(Done(code=done.returncode, out=done.stdout, err=done.stderr), code)
    if shown not in done.stdout + done.stderr or "\nverdict: ok" in done.stdout:
        raise Unhandled(f"it does not show {shown!r}, or is fooled: {done.stdout[-300:]}")


def _looks(name: str, seen: Seen) -> None:
    if error := seen.verbs[name]:
        raise error


def attacks(rng: random.Random) -> list[Attack]:
    topics = dict.fromkeys((*TOPICS, *(_name(rng) for _ in range(MANY))))
    spaces = (b"/", b"", b"//", b"/a-b", b"bad", b"/ok", b"/\x1b[31m")
    nodes = dict.fromkeys((*NODES, *((rng.choice(spaces), _name(rng)) for _ in range(MANY // 2))))
    every = (*((each,) for each in topics), *nodes)
    found = [Attack(name=f"{names!r}", run=Named(names)) for names in every]
    found += [Attack(name=each, run=functools.partial(_looks, each)) for each in (*VERBS, BLIND)]
    return found


CLASS = HostileClass(name="names", attacks=attacks, stage=stage)
