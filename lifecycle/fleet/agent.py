"""The other end of `lifecycle up --hosts`: starts a supervisor on this host and follows it.

Owns: `serve`, which runs for as long as the connection does. The supervisor is in a session of its
own and prints into pipes with a name, in a directory in its run directory, of which it has both
ends open: it neither ends nor waits if nobody reads, and the next agent reads on. What was sent
lies there, too, and vanishes with the run. Must not import rclpy.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import re
import selectors
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import IO

from lifecycle import dataclasses
from lifecycle.codec import from_json, to_json, to_plain
from lifecycle.errors import LifecycleError, UsageError
from lifecycle.fleet.protocol import (
    LONGEST_LINE,
    PROTOCOL,
    Do,
    Order,
    Part,
    Said,
    Word,
    line,
)
from lifecycle.run_directory import (
    SENT_PREFIX,
    is_held,
    is_process,
    lost,
    private_directory,
    read_record,
    runtime_root,
    start_ticks,
)

SILENT_S = 20.0
"""A coordinator that asks nothing for so long is gone, or its link is cut."""

_TAKE_S = 1.0
"""How long an agent that is to leave the supervisor to us may take, before it is killed."""

_CHUNK = 2**16
_BEHIND = 2**18
"""Bytes that may wait for the connection; beyond it nothing more is read of the supervisor, whose
own output then drops log lines and counts them."""

_LAST_S = 0.5
"""For what is still to be sent when an agent ends."""

_BEGIN_S = 10.0
"""Until a supervisor that was started can be asked."""
_LOOK_S = 0.02

_EVENTS, _ERRORS, _STARTED, _READER = "events", "errors", "started.json", "reader.json"
_FILES = "files"
_NAME = re.compile(r"[A-Za-z0-9_@][A-Za-z0-9_.@-]*")

COMMAND = (sys.executable, "-m", "lifecycle.cli")
"""This program again, in the same environment."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class _Process:
    """A process, named for as long as this host runs; with the digest of what it was given."""

    pid: int
    start_ticks: int
    digest: str = ""

    @property
    def lives(self) -> bool:
        return is_process(self.pid, self.start_ticks)


class _Pipe:
    """Whole lines of a pipe with a name.

    Attributes:
        is_empty: the last time there was nothing to read.
    """

    def __init__(self, path: Path, *, is_new: bool) -> None:
        self.descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        self._rest = b""
        self._torn = not is_new
        self.is_empty = False

    def read(self) -> tuple[bytes, ...]:
        """Return the lines that came; what an agent before us has read half of is left out."""
        try:
            data = os.read(self.descriptor, _CHUNK)
        except BlockingIOError:
            data = b""
        self.is_empty = not data
        *whole, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > LONGEST_LINE:
            self._rest, self._torn = b"", True
        if whole and self._torn:
            self._torn = False
            if not _is_json(whole[0]):
                del whole[0]
        return tuple(whole)


class _Followed:
    """A supervisor whose output this agent reads."""

    def __init__(
        self, directory: Path, process: _Process, child: subprocess.Popen[bytes] | None
    ) -> None:
        self.directory = directory
        self.process = process
        self.child = child
        self.pidfd = os.pidfd_open(process.pid)
        self.events = _Pipe(directory / _EVENTS, is_new=child is not None)
        self.errors = _Pipe(directory / _ERRORS, is_new=child is not None)

    @property
    def descriptors(self) -> tuple[int, int, int]:
        """All that is waited for."""
        return self.pidfd, self.events.descriptor, self.errors.descriptor

    def signal(self) -> None:
        with contextlib.suppress(ProcessLookupError):
            signal.pidfd_send_signal(self.pidfd, signal.SIGTERM)

    def ended(self) -> Said:
        """Bury it and remove what was sent, where its run did not come to have it."""
        code = None if self.child is None else self.child.wait()
        shutil.rmtree(self.directory, ignore_errors=True)
        with contextlib.suppress(OSError):
            self.directory.parent.rmdir()
        if code is not None and code < 0:
            return Said(agent=Word.ENDED, signal=-code)
        return Said(agent=Word.ENDED, exit_code=code)

    def close(self) -> None:
        for each in self.descriptors:
            os.close(each)


def serve(
    stdin: int, stdout: int, *, command: Sequence[str] = COMMAND, silent_s: float = SILENT_S
) -> None:
    """Carry out orders until there are none any more; the supervisor runs on.

    Args:
        stdin: where orders come from.
        stdout: where to answer.
        command: what `up` and `down` are verbs of.
        silent_s: see SILENT_S.
    """
    with contextlib.closing(_Agent(stdin, stdout, command, silent_s)) as agent:
        agent.run()


class _Agent:
    def __init__(self, stdin: int, stdout: int, command: Sequence[str], silent_s: float) -> None:
        self._stdin = stdin
        self._stdout = stdout
        self._command = command
        self._silent_s = silent_s
        self._rest = b""
        self._out = bytearray()
        self._followed: _Followed | None = None
        self._reader: int | None = None
        self._downs: dict[int, tuple[subprocess.Popen[bytes], IO[bytes]]] = {}
        self._is_taken = False
        self._woken, self._wakes = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._found = signal.signal(signal.SIGTERM, self._take)
        os.set_blocking(stdout, False)

    def _take(self, *_: object) -> None:
        self._is_taken = True
        with contextlib.suppress(BlockingIOError):
            os.write(self._wakes, b"\0")

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._flush(_LAST_S)
        signal.signal(signal.SIGTERM, self._found)
        self._leave()
        for child, errors in self._downs.values():
            child.kill()
            child.wait()
            errors.close()
        for each in (self._woken, self._wakes):
            os.close(each)

    def run(self) -> None:
        from importlib.metadata import version

        self._out += b"\n"  # what a login shell printed may have no end
        self._say(
            Said(agent=Word.HELLO, version=version("ros-lifecycle-manifests"), protocol=PROTOCOL)
        )
        asked_s = time.monotonic()
        while not self._is_taken:
            left_s = asked_s + self._silent_s - time.monotonic()
            if left_s <= 0:
                return
            ready = self._wait(left_s)
            if self._stdin in ready:
                asked_s = time.monotonic()
                if not self._read_orders():
                    return
            try:
                if self._stdout in ready:
                    self._flush(0)
            except OSError:
                return  # the connection is no more
            self._look(ready)
        self._say(Said(agent=Word.TAKEN))

    def _wait(self, left_s: float) -> set[int]:
        with selectors.DefaultSelector() as selector:
            for each in (self._stdin, self._woken, *self._downs):
                selector.register(each, selectors.EVENT_READ)
            if self._out:
                selector.register(self._stdout, selectors.EVENT_WRITE)
            if self._followed is not None and len(self._out) < _BEHIND:
                for each in self._followed.descriptors:
                    selector.register(each, selectors.EVENT_READ)
            return {each.fd for each, _ in selector.select(left_s)}

    def _read_orders(self) -> bool:
        """Carry out what was read; False at the end of all orders."""
        data = os.read(self._stdin, _CHUNK)
        received_s = time.time()
        if not data:
            return False
        *whole, self._rest = (self._rest + data).split(b"\n")
        for each in whole:
            self._carry_out(from_json(each, Order, longest=LONGEST_LINE), received_s)
        return len(self._rest) <= LONGEST_LINE

    def _carry_out(self, order: Order, received_s: float) -> None:
        if order.do is Do.PING:
            self._say(
                Said(
                    agent=Word.PONG,
                    number=order.number,
                    received_s=received_s,
                    sent_s=time.time(),
                )
            )
        elif order.do is Do.END:
            if self._followed is not None:
                self._followed.signal()
        else:
            try:
                if order.do is Do.DOWN:
                    self._down(order)
                elif order.do is Do.STATUS:
                    self._say(_status_of(self._run_of(order)))
                elif order.part is not None:
                    self._say(self._begin(order.part, starts=order.do is Do.START))
            except LifecycleError as error:
                self._say(Said(agent=Word.REFUSED, message=error.message, hint=error.hint))
            except OSError as error:
                where = f" {error.filename!r}" if error.filename else ""
                message = f"cannot start a supervisor: {error.strerror}{where}"
                self._say(Said(agent=Word.REFUSED, message=message))

    def _begin(self, part: Part, *, starts: bool) -> Said:
        """Start a supervisor, or follow the one that runs."""
        if self._followed is not None:
            raise UsageError("cannot follow two supervisors by one agent")
        path = self._path(part.name)
        private_directory(path.parent)
        # Only one agent looks and starts at once.
        root = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            fcntl.flock(root, fcntl.LOCK_EX)
            for directory, process in _sent(path):
                if process is not None and process.lives:
                    return self._attach(part, directory, process)
            by_hand = next(
                (each for each in self._paths(part.name, part.whole) if is_held(each)), None
            )
            if by_hand is not None:
                raise UsageError(
                    f"cannot follow {by_hand.name!r}: its supervisor runs already, and was not "
                    "started by lifecycle up --hosts",
                    hint=f"end it first: lifecycle down {by_hand.name}",
                )
            if not starts:
                return Said(agent=Word.ABSENT)
            for directory, _ in _sent(path):
                shutil.rmtree(directory, ignore_errors=True)
            return self._start(part, path)
        finally:
            os.close(root)

    @staticmethod
    def _path(name: str) -> Path:
        if not _NAME.fullmatch(name):
            raise UsageError(f"cannot use {name!r} as the name of a run")
        return runtime_root(os.environ) / name

    def _paths(self, name: str, whole: str) -> tuple[Path, ...]:
        """Return where the run of a machine may be: its own, and that of all of this host's."""
        return tuple(map(self._path, (name, whole) if whole else (name,)))

    def _run_of(self, order: Order) -> Path:
        """Return where the run is that an order is about; where it would be if there is none."""
        found = self._paths(order.name, order.whole)
        return next((each for each in found if is_held(each) or read_record(each)), found[0])

    def _start(self, part: Part, path: Path) -> Said:
        directory = path / f"{SENT_PREFIX}{os.urandom(8).hex()}"
        private_directory(path)
        directory.mkdir(mode=0o700)
        try:
            for file in part.files:
                target = directory.joinpath(_FILES, *_relative(file.path))
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(file.data)
            manifest = Path(part.manifest)
            if not manifest.is_absolute():
                manifest = directory.joinpath(_FILES, *_relative(part.manifest))
            # The supervisor has both ends open, so that it can write whoever reads.
            with contextlib.ExitStack() as stack:
                ends = []
                for name in (_EVENTS, _ERRORS):
                    os.mkfifo(directory / name, 0o600)
                    ends.append(os.open(directory / name, os.O_RDWR | os.O_CLOEXEC))
                    stack.callback(os.close, ends[-1])
                child = subprocess.Popen(
                    [
                        *self._command,
                        "up",
                        *("--machine", part.machine, "--format", "json"),
                        *part.options,
                        *("--", str(manifest), *part.arguments),
                    ],
                    stdin=subprocess.DEVNULL,
                    stdout=ends[0],
                    stderr=ends[1],
                    start_new_session=True,
                )
                process = _Process(
                    pid=child.pid, start_ticks=start_ticks(child.pid) or 0, digest=part.digest
                )
                (directory / _STARTED).write_bytes(to_json(process))
                self._followed = _Followed(directory, process, child)
        except BaseException:
            shutil.rmtree(directory, ignore_errors=True)
            raise
        self._read_alone(directory)
        return Said(agent=Word.STARTED, pid=child.pid)

    def _attach(self, part: Part, directory: Path, process: _Process) -> Said:
        if process.digest != part.digest:
            raise UsageError(
                f"cannot follow {part.name!r}: it runs already, with another manifest or other "
                "arguments",
                hint=f"end it first: lifecycle down {part.name}",
            )
        self._read_alone(directory)
        try:
            self._followed = _Followed(directory, process, None)
        except OSError:  # it ended just now
            return Said(agent=Word.ABSENT)
        return Said(agent=Word.ATTACHED, pid=process.pid, status=_status(directory.parent))

    def _read_alone(self, directory: Path) -> None:
        """Have the agent before us leave, which nobody may be at the other end of any more."""
        path = directory / _READER
        self._reader = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(self._reader, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            _end(_process(path))
            try:
                fcntl.flock(self._reader, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise UsageError(
                    "cannot follow a supervisor that another coordinator follows, which does not "
                    "leave"
                ) from error
        ours = _Process(pid=os.getpid(), start_ticks=start_ticks(os.getpid()) or 0)
        os.ftruncate(self._reader, 0)
        os.pwrite(self._reader, to_json(ours), 0)

    def _look(self, ready: set[int]) -> None:
        """Pass on what the supervisor wrote, and what ended."""
        for each in ready & self._downs.keys():
            child, errors = self._downs.pop(each)
            os.close(each)
            errors.seek(0)
            message = errors.read().decode(errors="replace").strip()
            errors.close()
            self._say(Said(agent=Word.DONE, exit_code=child.wait(), message=message))
        followed = self._followed
        if followed is None:
            return
        self._pass_on(followed, ready)
        if followed.pidfd in ready:
            followed.events.is_empty = followed.errors.is_empty = False
            while not (followed.events.is_empty and followed.errors.is_empty):
                self._pass_on(followed, {*followed.descriptors})
            self._say(followed.ended())
            self._leave()

    def _pass_on(self, followed: _Followed, ready: set[int]) -> None:
        if followed.events.descriptor in ready:
            for each in followed.events.read():
                self._out += each + b"\n"
        if followed.errors.descriptor in ready:
            sent = f"{followed.directory / _FILES}/"
            for each in followed.errors.read():
                message = each.decode(errors="replace").replace(sent, "")
                self._say(Said(agent=Word.STDERR, message=message))

    def _leave(self) -> None:
        if self._followed is not None:
            self._followed.close()
            self._followed = None
        if self._reader is not None:
            os.close(self._reader)
            self._reader = None

    def _down(self, order: Order) -> None:
        """End a run, whoever started it."""
        path = self._run_of(order)
        deadline = time.monotonic() + _BEGIN_S
        while not is_held(path) and time.monotonic() < deadline:
            if not any(process is not None and process.lives for _, process in _sent(path)):
                break
            time.sleep(_LOOK_S)  # it has just been started, and cannot be asked yet
        if not is_held(path) and read_record(path) is None:
            self._say(Said(agent=Word.ABSENT))
            return
        import tempfile

        errors = tempfile.TemporaryFile()  # noqa: SIM115 - until that has ended
        child = subprocess.Popen(
            [*self._command, "down", path.name, "--timeout", str(order.timeout_s)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=errors,
            start_new_session=True,
        )
        self._downs[os.pidfd_open(child.pid)] = child, errors

    def _say(self, said: Said) -> None:
        self._out += line(said)

    def _flush(self, seconds: float) -> None:
        """Write what can be written, for so long.

        Raises:
            OSError: the connection is no more.
        """
        deadline = time.monotonic() + seconds
        while self._out:
            with contextlib.suppress(BlockingIOError):
                del self._out[: os.write(self._stdout, self._out[:_CHUNK])]
                continue
            left_s = deadline - time.monotonic()
            if left_s <= 0:
                return
            with selectors.DefaultSelector() as selector:
                selector.register(self._stdout, selectors.EVENT_WRITE)
                selector.select(left_s)


def _sent(path: Path) -> Iterator[tuple[Path, _Process | None]]:
    """Yield what was sent for a run, and by whom it is run."""
    if path.is_dir():
        for each in sorted(path.iterdir()):
            if each.name.startswith(SENT_PREFIX):
                yield each, _process(each / _STARTED)


def _process(path: Path) -> _Process | None:
    with contextlib.suppress(OSError, ValueError):
        return from_json(path.read_bytes(), _Process, longest=_CHUNK)
    return None


def _end(process: _Process | None) -> None:
    """End another agent."""
    if process is None or not process.lives or process.pid == os.getpid():
        return
    with contextlib.suppress(ProcessLookupError):
        pidfd = os.pidfd_open(process.pid)
        try:
            with selectors.DefaultSelector() as selector:
                selector.register(pidfd, selectors.EVENT_READ)
                for number in (signal.SIGTERM, signal.SIGKILL):
                    signal.pidfd_send_signal(pidfd, number)
                    if selector.select(_TAKE_S):
                        return
        finally:
            os.close(pidfd)


def _status(path: Path) -> object:
    """Return the status of a run; None while its supervisor has none to give."""
    from lifecycle.supervisor import status

    try:
        return to_plain(status(path))
    except (LifecycleError, OSError):
        return None


def _status_of(path: Path) -> Said:
    """Return the status of a run, or why there is none.

    Raises:
        UsageError: its supervisor was killed, or does not answer.
    """
    if not is_held(path):
        if read_record(path) is not None:
            raise lost(path)
        return Said(agent=Word.ABSENT)
    from lifecycle.supervisor import status

    try:
        return Said(agent=Word.STATUS, status=to_plain(status(path)))
    except TimeoutError as error:
        raise UsageError(f"cannot ask {path.name!r}: its supervisor does not answer") from error


def _relative(path: str) -> tuple[str, ...]:
    """Return the parts of a path that lead out of no directory.

    Raises:
        UsageError: they would.
    """
    pure = PurePosixPath(path)
    if pure.is_absolute() or ".." in pure.parts or not pure.parts or "\0" in path:
        raise UsageError(f"cannot take the file {path!r}: it would lie outside of its directory")
    return pure.parts


def _is_json(data: bytes) -> bool:
    try:
        json.loads(data)
    except ValueError:
        return False
    return True
