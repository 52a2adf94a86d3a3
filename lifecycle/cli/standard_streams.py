"""Standard output and error that are closed, full or not read, and what is lost then.

Owns: `own_streams`, which keeps standard output for what a verb prints (Fast DDS 2.14 prints errors
of TCP connections there), and after which writing to either stream never raises; and `Writer`, by
which a supervisor never waits for a reader.
"""

from __future__ import annotations

import collections
import contextlib
import errno
import io
import os
import select
import shutil
import signal
import stat
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, NoReturn, TextIO, cast

import click

from lifecycle.errors import ExitCode, MiddlewareError
from lifecycle.printable import count

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

_STDIN, _STDOUT, _STDERR = 0, 1, 2

LINE_BYTES = 2**20
"""Log lines are lost while so much is unread, until half of it was read."""

EVENT_BYTES = 2**24
"""Of everything else so much waits for a reader; what comes then is lost, too."""

DRAIN_S = 2.0
"""In the end, a reader that takes nothing for so long is not waited for."""

_LONGEST_DRAIN_S = 20.0

_CHUNK_BYTES = 2**16
_BEHIND_BYTES = 2**16
_FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
"""Errors of a disk that may have room again; after any other a stream has ended."""


class _Raw(io.RawIOBase):
    """The raw end of a stream: what a Writer takes, else writes until that fails and none then.

    Attributes:
        error: why it failed.
    """

    def __init__(self, descriptor: int, writer: Writer | None = None) -> None:
        self._descriptor = descriptor
        self._writer = writer
        self.error: OSError | None = None

    def writable(self) -> bool:
        return True

    def fileno(self) -> int:
        return self._descriptor

    def isatty(self) -> bool:
        return os.isatty(self._descriptor)

    def write(self, data: ReadableBuffer) -> int:
        left = memoryview(data).cast("B")
        size = len(left)
        if self._writer is not None:
            self._writer.put(bytes(left).decode(errors="replace"), kept=False)
            return size
        try:
            while left and self.error is None:
                left = left[_write_some(self._descriptor, left) :]
        except OSError as error:
            self.error = error
        return size


def own_streams(*, waits: bool = True) -> Callable[[int], int]:
    """Have only `sys.stdout` write to standard output, and no failure of it or stderr raise.

    What writes to descriptor 1 itself, as C++ does, comes out on standard error; so does what child
    processes print that are given no other. A stream that is closed becomes one to nowhere. Unless
    it `waits`, what readers of standard error do not read in time is dropped.

    Returns:
        What writes the rest and returns the exit code in the end: no success if the result was
        lost. A reader that went away, as `head` does, has read what it wanted.
    """
    _open_closed()
    stdout = _Raw(os.dup(_STDOUT))
    _replace("stdout", io.BufferedWriter(stdout))
    stderr = os.dup(_STDERR)
    writer = None
    if not waits:
        with contextlib.suppress(MiddlewareError):  # the verb will say so
            writer = Writer(stderr, "standard error", marker="{}\n".format)
            _never_wait(_STDERR)
    _replace("stderr", _Raw(stderr, writer))
    os.dup2(_STDERR, _STDOUT)

    def settled(code: int) -> int:
        sys.stdout.flush()
        if stdout.error is not None and stdout.error.errno in _FULL:
            sys.stderr.write(f"cannot write standard output: {stdout.error.strerror}\n")
            code = code or ExitCode.USAGE
        sys.stderr.flush()
        if writer is not None:
            writer.close()
        return code

    return settled


def echo_while_read(text: str) -> None:
    """Print one text of many that follow changes; end the verb once they are not read any more.

    Raises:
        Exit: standard output has ended.
    """
    click.echo(text)
    raw = getattr(getattr(sys.stdout, "buffer", None), "raw", None)
    if isinstance(raw, _Raw) and raw.error is not None:
        raise click.exceptions.Exit(ExitCode.OK)


def _replace(name: str, under: io.RawIOBase | io.BufferedWriter) -> None:
    now = cast("TextIO | None", getattr(sys, name))
    if now is not None:
        now.flush()
    stream = io.TextIOWrapper(
        cast("io.BufferedWriter", under),
        encoding=now.encoding if now is not None else "utf-8",
        errors="backslashreplace",
        line_buffering=now is not None and bool(getattr(now, "line_buffering", False)),
        write_through=not isinstance(under, io.BufferedWriter),
    )
    setattr(sys, name, stream)


def _open_closed() -> None:
    """Have no file that is opened later become one of the standard streams."""
    null = os.open(os.devnull, os.O_RDWR)
    for number in range(null, _STDERR + 1):  # the lowest that was free, and those above it
        if number == null or not Path(f"/proc/self/fd/{number}").exists():
            os.dup2(null, number)
            os.set_inheritable(number, True)
    if null > _STDERR:
        os.close(null)


def _never_wait(descriptor: int) -> None:
    """Have C++ lose what it writes to a full pipe or a stopped terminal, instead of waiting.

    Only here: who shares the descriptor keeps a description, and so flags, of its own (open(2)).
    A file has no reader to wait for; a socket cannot be opened anew.
    """
    mode = os.fstat(descriptor).st_mode
    if not stat.S_ISFIFO(mode) and not os.isatty(descriptor):
        return
    with contextlib.suppress(OSError):
        flags = os.O_WRONLY | os.O_NONBLOCK | os.O_NOCTTY
        again = os.open(f"/proc/self/fd/{descriptor}", flags)
        os.dup2(again, descriptor)
        os.close(again)


def _write_some(descriptor: int, data: memoryview) -> int:
    """Write something, also where the descriptor was made non-blocking."""
    while True:
        try:
            return os.write(descriptor, data)
        except BlockingIOError:  # noqa: PERF203 - rare
            poll = select.poll()
            poll.register(descriptor, select.POLLOUT)
            poll.poll()


class Writer:
    """Writes texts in a thread of its own: who prints never waits, and never fails.

    What is not read in time is lost as LINE_BYTES and EVENT_BYTES say, what a full disk does not
    take is lost, and both are counted and said in the stream once there is room again.

    Args:
        name: of the stream, for messages.
        marker: makes the note in the stream from a message about the loss.
        say: takes messages that the stream itself cannot take, from any thread.

    Raises:
        MiddlewareError: there is no room for another thread.
    """

    def __init__(
        self,
        descriptor: int,
        name: str,
        *,
        marker: Callable[[str], str],
        say: Callable[[str], object] = lambda _: None,
        encoding: str = "utf-8",
    ) -> None:
        self._descriptor = descriptor
        self._name = name
        self._marker = marker
        self._say = say
        self._encoding = encoding
        self._changed = threading.Condition()
        # Each with the number of lines that are lost with it; of a note, of those that it counts.
        self._queue: collections.deque[tuple[bytes, int]] = collections.deque()
        self._bytes = 0
        self._lost = 0
        self._full = ""  # why the disk takes nothing
        self._gone = False
        self._closing = False
        self._progress = 0
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        try:
            self._thread.start()
        except RuntimeError as error:
            from lifecycle.middleware.process.control import no_room_for_threads

            raise no_room_for_threads(1) from error

    def put(self, text: str, *, kept: bool = True) -> None:
        """Write whole lines once there is room for them; a log line is not `kept` as long."""
        size = len(data := text.encode(self._encoding, "backslashreplace"))
        with self._changed:
            if self._gone or self._closing:
                return
            self._note_lost()
            has_room = self._bytes + size <= (EVENT_BYTES if kept else LINE_BYTES)
            if has_room and (kept or not self._lost):
                self._append(data, text.count("\n"))
            else:
                self._lost += text.count("\n")

    @property
    def is_behind(self) -> bool:
        """Whether a reader has stopped, is too slow, or has gone."""
        return self._gone or self._bytes > _BEHIND_BYTES

    def close(self) -> None:
        """Write what is left, for as long as it is taken; say what is lost in the end.

        Again is harmless.
        """
        deadline = time.monotonic() + _LONGEST_DRAIN_S
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        seen = -1
        while self._thread.is_alive() and seen != self._progress and time.monotonic() < deadline:
            seen = self._progress
            self._thread.join(DRAIN_S)
        with self._changed:
            gone, self._gone = self._gone, True
            lost = self._lost + sum(number for _, number in self._queue)
        if lost and not gone:
            self._say(f"{_lines_are(lost)} missing at the end of {self._name}: {self._why}")

    @property
    def _why(self) -> str:
        return self._full or f"nobody read {self._name} in time"

    def _append(self, data: bytes, number: int) -> None:
        self._queue.append((data, number))
        self._bytes += len(data)
        self._changed.notify_all()

    def _note_lost(self) -> None:
        """Queue a note on what is lost, once there is room."""
        if self._lost and self._bytes <= LINE_BYTES // 2:
            note = self._marker(f"{_lines_are(self._lost)} missing here: {self._why}")
            lost, self._lost = self._lost, 0
            self._append(note.encode(self._encoding, "backslashreplace"), lost)

    def _run(self) -> None:
        torn, said_full = b"", False
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._gone or self._closing or self._queue)
                if self._gone or not self._queue:
                    return
                text, number = self._queue[0]
            left = memoryview(torn + text)
            message = full = ""
            gone = False
            try:
                while left:
                    left = left[_write_some(self._descriptor, left[:_CHUNK_BYTES]) :]
                    torn = b"\n" if left else b""
                    self._progress += 1
            except OSError as error:
                gone, full = error.errno not in _FULL, str(error.strerror)
            if gone:
                message = f"{self._name} was closed by its reader; the run goes on without it"
            elif full and not said_full:
                said_full = True
                message = (
                    f"cannot write {self._name}: {full}; the run goes on, and what is lost is "
                    "counted"
                )
            with self._changed:
                self._queue.popleft()
                self._bytes -= len(text)
                self._gone |= gone
                self._full = full
                if full:
                    self._lost += number
                else:
                    self._note_lost()
            if message:
                self._say(message)


def _lines_are(number: int) -> str:
    return f"{count(number, 'line')} {'is' if number == 1 else 'are'}"


# XTerm Control Sequences: the alternate screen, the cursor, and lines that end at the edge.
_BEGIN, _END = "\x1b[?1049h\x1b[?25l\x1b[?7l", "\x1b[?7h\x1b[?25h\x1b[?1049l"
_HOME, _ERASE_LINE, _ERASE_BELOW = "\x1b[H", "\x1b[K", "\x1b[J"


@contextlib.contextmanager
def watched(*, whole: bool = True) -> Iterator[Callable[[str], None]]:
    """Give what shows one text in the place of the last, in the main thread. Ctrl-C ends it.

    What does not fit on the terminal is cut off. The last text stays on the ordinary screen.

    Args:
        whole: False where each text belongs behind the other on a terminal, too, as JSON does.
    """
    last = ""

    def follow(text: str) -> None:
        nonlocal last
        if text.rstrip("\n") != last:
            last = text.rstrip("\n")
            echo_while_read(last)

    if not whole or sys.stdout is None or not sys.stdout.isatty():
        yield follow
        return

    def write(text: str) -> None:
        sys.stdout.write(text)
        sys.stdout.flush()

    def show(text: str) -> None:
        nonlocal last
        last = text.rstrip("\n")
        rows = [f"{_ERASE_LINE}{row}" for row in last.split("\n")]
        height = shutil.get_terminal_size().lines
        if len(rows) < height:
            rows.append(_ERASE_BELOW)
        write(_HOME + "\n".join(rows[:height]))

    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, _end)
    write(_BEGIN)
    try:
        yield show
    finally:
        write(_END)
        echo_while_read(last)


def _end(number: int, _: FrameType | None) -> NoReturn:
    """Leave the terminal as it was, and end as the signal says."""
    raise SystemExit(128 + number)
