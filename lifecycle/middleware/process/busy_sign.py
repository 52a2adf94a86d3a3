"""Hang detection between two processes: a page that one writes when it is busy and the other reads.

The busy one writes the time into the page. The watcher looks once per limit, and when something
that it saw may be over its limit: neither the lock of an interpreter, nor a blocked thread, nor
SIGSTOP keeps it from noticing then. Must not import rclpy.

Time during which the thread could have run and got no processor is not its own. The kernel counts
it for each thread (run_delay of /proc/TID/schedstat, Documentation/scheduler/sched-stats.rst), up
to its last turn. One that is ready to run hangs once it has run for long beyond the limit; another,
once the limit has passed without what it waited for a processor.

The page has room for what the busy one does, in words, and the file behind it for where its threads
stand: asked by a signal, faulthandler writes it there from C, so that code which never gives up the
interpreter's lock is seen as well.
"""

from __future__ import annotations

import contextlib
import faulthandler
import mmap
import os
import re
import signal
import sysconfig
import threading
import time
import typing
from pathlib import Path

from lifecycle.errors import MiddlewareError

_PAGE_BYTES = mmap.PAGESIZE
_SINCE, _LIMIT, _THREAD, _ANSWERS = range(4)
_WHAT = 64
_WHAT_BYTES = 256
_NS = 1_000_000_000

_SLOW_PARTS = 4
"""Whoever has run for this part of the limit beyond it is slow by itself."""


class _Turns(typing.NamedTuple):
    """What a thread had of the processors until its last turn."""

    thread: int  # its id; of a process, negative, it is what all of its threads waited together
    at_ns: int  # when this was read, CLOCK_MONOTONIC
    ran_ns: int  # time on a processor
    waited_ns: int  # time ready to run, without one
    ready: bool  # it runs, or could


@typing.final
class BusySign:
    """Shared by one thread that is busy or idle and one process of this host that watches it."""

    def __init__(self, page: int) -> None:
        self._page = page
        self._memory = mmap.mmap(page, _PAGE_BYTES)
        self._words = memoryview(self._memory).cast("q")
        self._looked_at = (0, False)
        self._last: _Turns | None = None  # at the last look
        self._before: _Turns | None = None  # at the last look before it became busy
        self._overdue: _Turns | None = None  # at the first look beyond the limit

    @classmethod
    def make(cls, limit_s: float) -> BusySign:
        """Make a sign whose holder may be busy for `limit_s` seconds, > 0, at a time."""
        try:
            page = os.memfd_create("lifecycle-busy", os.MFD_CLOEXEC)
            os.ftruncate(page, _PAGE_BYTES)
        except OSError as error:
            raise MiddlewareError(f"cannot use memfd_create: {error.strerror}") from error
        sign = cls(page)
        sign._words[_LIMIT] = round(limit_s * _NS)
        return sign

    @property
    def descriptor(self) -> int:
        """What the other process needs to make its own `BusySign(descriptor)`."""
        return self._page

    @property
    def limit_s(self) -> float:
        """Seconds, > 0."""
        return self._words[_LIMIT] / _NS

    # The holder's side.

    def show_stacks(self) -> None:
        """Have this process append its stacks to the page's file whenever `where` asks for them.

        The caller's thread, and those that begin after this, do not take the signal: what waits in
        one of them is not interrupted. One thread has to call `show_stacks_here`.
        """
        signal.pthread_sigmask(signal.SIG_BLOCK, {_SIGNAL})
        with contextlib.suppress(OSError, RuntimeError, ValueError):
            # Of its own offset, and at the end wherever the file is cut.
            flags = os.O_WRONLY | os.O_APPEND | os.O_CLOEXEC
            file = os.open(f"/proc/self/fd/{self._page}", flags)
            faulthandler.register(_SIGNAL, file=file, all_threads=True)
            self._words[_ANSWERS] = True

    def begin(self, after_s: float = 0.0, what: str = "", *, for_process: bool = False) -> None:
        """Be busy from now on, or from so many seconds on unless `begin` or `end` comes before.

        Args:
            after_s: seconds.
            what: it does, in words.
            for_process: be busy for all threads: what any of them waited for a processor is not
                its own time.
        """
        words, text = self._words, what.encode()[: _WHAT_BYTES - 1] + b"\0"
        self._memory[_WHAT : _WHAT + len(text)] = text
        words[_THREAD] = -os.getpid() if for_process else threading.get_native_id()
        words[_SINCE] = time.monotonic_ns() + round(after_s * _NS)

    def end(self) -> float | None:
        """Be idle; returns for how many seconds it was busy if that was beyond the limit."""
        words = self._words
        since = words[_SINCE]
        words[_SINCE] = 0
        busy = time.monotonic_ns() - since
        return busy / _NS if since and busy >= words[_LIMIT] else None

    # The watcher's side.

    def look(self) -> tuple[bool, float]:
        """Return whether the holder hangs: it is busy beyond its limit; and when to look again.

        That is said once for what the holder does; the other is seconds, > 0.
        """
        # The time first: what the holder measures itself is then never less.
        now = time.monotonic_ns()
        since, limit = self._words[_SINCE], self._words[_LIMIT]
        turns = _turns_of(self._words[_THREAD], now)
        if since != self._looked_at[0]:
            self._looked_at = (since, False)
            self._before, self._overdue = self._last, None
        self._last = turns
        left = since + limit - now if since else limit
        if left > 0:
            return False, min(left, limit) / _NS
        said, own = self._looked_at[1], self._own_ns(since, now, turns)
        self._looked_at = (since, said or own >= limit)
        part = limit // _SLOW_PARTS
        left = limit - own if part < own < limit else part
        return own >= limit and not said, left / _NS

    def _own_ns(self, since: int, now: int, turns: _Turns | None) -> int:
        """Return for how much of the time since then it ran, or waited for something else."""
        if turns is None:  # a kernel that does not count: all of the time is its own
            return now - since
        if self._overdue is None or self._overdue.thread != turns.thread:
            self._overdue = turns
        if turns.ready:
            # It may have been ready for long without a turn, which is counted at its next one.
            part = self._words[_LIMIT] // _SLOW_PARTS
            return now - since if turns.ran_ns - self._overdue.ran_ns >= part else 0
        before = self._before
        if before is None or before.thread != turns.thread:
            before = self._before = turns
        return now - max(since, before.at_ns) - (turns.waited_ns - before.waited_ns)

    @property
    def what(self) -> str:
        """What the holder does, as it calls it; empty where it does not say."""
        text = bytes(self._memory[_WHAT : _WHAT + _WHAT_BYTES])
        return text.partition(b"\0")[0].decode(errors="replace")

    def where(self, pid: int) -> str:
        """Return where the threads of the holder stand, as faulthandler writes it, within 0.25 s.

        Empty if it does not answer: it was stopped, or is not one of ours.
        """
        if pid <= 0 or not self._words[_ANSWERS]:
            return ""
        try:
            os.ftruncate(self._page, _PAGE_BYTES)
            os.kill(pid, _SIGNAL)
        except OSError:
            return ""
        size = _PAGE_BYTES
        began = grown = time.monotonic()
        while (now := time.monotonic()) - began < _WITHIN_S:
            if (more := os.fstat(self._page).st_size) != size:
                size, grown = more, now
            elif size > _PAGE_BYTES and now - grown >= _STILL_S:
                break
            time.sleep(0.001)
        return os.pread(self._page, _MOST_BYTES, _PAGE_BYTES).decode(errors="replace")

    def close(self) -> None:
        """Close this side; again is harmless."""
        if self._page >= 0:
            self._words.release()
            self._memory.close()
            os.close(self._page)
            self._page = -1


def _turns_of(thread: int, now: int) -> _Turns | None:
    """Read what a thread of this host had of the processors; None where that is not known."""
    if thread < 0:
        folder = Path(f"/proc/{-thread}/task")
        try:
            every = [_turns_of(int(each.name), now) for each in folder.iterdir()]
        except OSError:
            return None
        waited = sum(each.waited_ns for each in every if each is not None)
        return _Turns(thread=thread, at_ns=now, ran_ns=0, waited_ns=waited, ready=False)
    try:
        counted = Path(f"/proc/{thread}/schedstat").read_bytes().split()
        state = Path(f"/proc/{thread}/stat").read_bytes().rpartition(b")")[2].split()[0]
        ran, waited = int(counted[0]), int(counted[1])
    except (OSError, IndexError, ValueError):
        return None
    if not ran:
        return None
    return _Turns(thread=thread, at_ns=now, ran_ns=ran, waited_ns=waited, ready=state == b"R")


_SIGNAL = signal.SIGRTMAX - 3
"""Programs do not use it; only who shows its stacks is sent it."""

_WITHIN_S = 0.25
_STILL_S = 0.01
"""An answer is complete once nothing came for so long: it is written within a millisecond."""

_MOST_BYTES = 1 << 16
_FRAME = re.compile(r'  File "(?P<file>.*)", line (?P<line>\d+) in (?P<name>.*)')
_SHOWN = 3

_PACKAGE = f"{Path(__file__).parents[2]}{os.sep}"
_HOST = f"{_PACKAGE}node{os.sep}host{os.sep}"
_STDLIB = f"{sysconfig.get_path('stdlib')}{os.sep}"
_PACKAGES = ("site-packages", "dist-packages")


def show_stacks_here() -> None:
    """Take the signal in this thread; it must not mind being interrupted."""
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {_SIGNAL})


def brief(stacks: str) -> str:
    """Return where the code of a callback stands; empty where no thread is in one.

    The function that was called back, and the last ones that it called: `hear (robot.py:12) > read
    (robot.py:40)`. What belongs to our executor, rclpy or Python is left out.
    """
    found = []
    for thread in re.split(r"\n\n|(?=Current thread|Thread 0x)", stacks):
        frames = [match.groups() for match in map(_FRAME.match, thread.splitlines()) if match]
        # What a host was forked from is below it, a command line with its libraries.
        hosts = [index for index, (file, *_) in enumerate(frames) if file.startswith(_HOST)]
        frames = frames[: hosts[0] + 1] if hosts else frames
        users = [index for index, (file, *_) in enumerate(frames) if _is_users(file)]
        if not users or not any(_is_executor(file) for file, *_ in frames[users[-1] + 1 :]):
            continue
        chosen = [*users[: _SHOWN - 1], users[-1]] if len(users) > _SHOWN else users
        shown = [frames[index] for index in dict.fromkeys(reversed(chosen))]
        found.append(" > ".join(f"{name} ({_short(file)}:{line})" for file, line, name in shown))
    return "; ".join(dict.fromkeys(found[:2]))


def _is_executor(file: str) -> bool:
    return file.startswith(_PACKAGE) or "/rclpy/" in file


def _is_users(file: str) -> bool:
    if file.startswith("<") or _is_executor(file):
        return False
    return not file.startswith(_STDLIB) or any(each in file for each in _PACKAGES)


def _short(file: str) -> str:
    with contextlib.suppress(ValueError, OSError):
        return str(Path(file).relative_to(Path.cwd()))
    return file
