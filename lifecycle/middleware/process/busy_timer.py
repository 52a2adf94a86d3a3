"""Hang detection between two processes: a shared busy-since page and a timerfd for the watcher.

Owns: the page of memory and the timerfd(2) that the two processes share. The busy one writes the
time of day into the page, which costs less than a microsecond and no system call; it arms the timer
no more than once per limit. The watcher sleeps until the timer fires and then reads the page. So an
idle process causes no wake-ups, and neither the lock of an interpreter, nor a blocked thread, nor
SIGSTOP keeps the other from noticing. Must not import rclpy.

Time during which the thread could have run and got no processor is not its own: on an overloaded
machine a callback of milliseconds takes seconds. The kernel counts it for each thread (run_delay of
/proc/TID/schedstat, Documentation/scheduler/sched-stats.rst), up to its last turn. The busy one
reads that when it arms the timer, the watcher when it looks.

The page has room for what the busy one does, in words, and the file behind it for where its threads
stand (stacks.py).

Python has timerfd from 3.13 on; until then it is called through ctypes.
"""

from __future__ import annotations

import contextlib
import ctypes
import enum
import functools
import mmap
import os
import threading
import time
import typing
from pathlib import Path

from lifecycle import dataclasses
from lifecycle.errors import MiddlewareError
from lifecycle.middleware.process import stacks
from lifecycle.middleware.process.control import TimerSpec, libc

_TFD_NONBLOCK = 0o4000
_TFD_CLOEXEC = 0o2000000
_COUNT_BYTES = 8
_PAGE_BYTES = mmap.PAGESIZE
_SINCE = 0
_LIMIT = 1
_THREAD = 2
_DELAY = 3
_ANSWERS = 4
_WHAT = 64
_WHAT_BYTES = 256
_NS = 1_000_000_000
_STAT_BYTES = 128
_LEAST_NS = 1_000_000
"""A timer armed with 0 would be off."""

_AGAIN_NS = 30_000_000
"""Between two looks at a thread that is ready to run: a kernel counts its turns at each tick, up to
10 ms apart."""

_SLOW_PARTS = 4
_UNSERVED_LIMITS = 5
"""So many times the limit without a processor is a fault of its own."""


class Overdue(enum.Enum):
    """Why a thread is busy beyond its limit."""

    HANGS = "hangs"  # in what it does
    UNSERVED = "unserved"  # it is ready to run, and the machine has no processor for it


@dataclasses.dataclass(frozen=True, slots=True)
class _Turns:
    """What a thread had of the processors until its last turn.

    Attributes:
        at_ns: when this was read, CLOCK_MONOTONIC.
        ran_ns: time on a processor.
        waited_ns: time ready to run, without one.
        ready: it runs, or could.
    """

    at_ns: int
    ran_ns: int
    waited_ns: int
    ready: bool


@typing.final
class BusySign:
    """Shared by one thread that is busy or idle and one process that watches it; `close` it.

    Both sides read CLOCK_MONOTONIC, so they must be on one host.
    """

    def __init__(self, timer: int, page: int) -> None:
        self._timer = timer
        self._page = page
        self._memory = mmap.mmap(page, _PAGE_BYTES)
        self._words = memoryview(self._memory).cast("q")
        self._armed_until = 0
        self._thread = 0
        self._turns = -1
        self._looked: tuple[int, _Turns] | None = None
        self._of_process = False
        self._set_time = _set_time()

    @classmethod
    def make(cls, limit_s: float) -> BusySign:
        """Make a sign whose holder may be busy for `limit_s` seconds, > 0, at a time.

        Raises:
            MiddlewareError: the kernel refused.
        """
        timer = libc().timerfd_create(time.CLOCK_MONOTONIC, _TFD_NONBLOCK | _TFD_CLOEXEC)
        if timer < 0:
            raise MiddlewareError(
                f"cannot use timerfd_create: {os.strerror(ctypes.get_errno())}",
                hint="hung nodes are noticed by it; a sandbox has to allow it",
            )
        try:
            page = os.memfd_create("lifecycle-busy", os.MFD_CLOEXEC)
            os.ftruncate(page, _PAGE_BYTES)
        except OSError as error:
            os.close(timer)
            raise MiddlewareError(f"cannot use memfd_create: {error.strerror}") from error
        sign = cls(timer, page)
        sign._words[_LIMIT] = round(limit_s * _NS)
        return sign

    @property
    def descriptors(self) -> tuple[int, int]:
        """What the other process needs to make its own `BusySign(*descriptors)`."""
        return self._timer, self._page

    @property
    def limit_s(self) -> float:
        """Seconds, > 0."""
        return self._words[_LIMIT] / _NS

    # The holder's side.

    def speak_for_process(self) -> None:
        """Be busy for all threads: what any of them waited for a processor is not its own time."""
        self._of_process = True

    def show_stacks(self) -> None:
        """Have this process show where it stands, see `where`."""
        self._words[_ANSWERS] = stacks.answer(self._page)

    def begin(self, after_s: float = 0.0, what: bytes = b"\0") -> None:
        """Be busy from now on, or from so many seconds on unless `begin` or `end` comes before.

        Args:
            after_s: seconds.
            what: is done; from `label`.
        """
        words = self._words
        self._memory[_WHAT : _WHAT + len(what)] = what
        words[_SINCE] = time.monotonic_ns() + round(after_s * _NS)
        # Read anew, after the page says busy: a watcher that the timer wakes must see it.
        now = time.monotonic_ns()
        if now >= self._armed_until:
            limit = words[_LIMIT]
            self._armed_until = now + limit
            self._note_turns()
            self._arm(limit)

    def end(self) -> float | None:
        """Be idle; returns for how many seconds it was busy if that was beyond the limit."""
        words = self._words
        since = words[_SINCE]
        words[_SINCE] = 0
        busy = time.monotonic_ns() - since
        return busy / _NS if since and busy >= words[_LIMIT] else None

    # The watcher's side.

    def fileno(self) -> int:
        """Return the timer, which is readable when it is time to ask `overdue`."""
        return self._timer

    def overdue(self) -> Overdue | None:
        """Return why the holder is busy beyond its limit, if it is; else look again in time."""
        with contextlib.suppress(BlockingIOError):
            os.read(self._timer, _COUNT_BYTES)
        # The time first: what the holder measures itself is then never less.
        now = time.monotonic_ns()
        since, limit = self._words[_SINCE], self._words[_LIMIT]
        if not since:
            return None
        left = since + limit - now
        if left <= 0:
            own, again = self._own_ns(since, now)
            if own >= limit:
                return Overdue.HANGS
            left = min(again or limit, limit - own)
        self._arm(max(left, _LEAST_NS))
        return Overdue.UNSERVED if now - since >= _UNSERVED_LIMITS * limit else None

    def _own_ns(self, since: int, now: int) -> tuple[int, int]:
        """Return for how much of the time since then the holder ran, or waited for something else.

        What it waited for a processor is known from up to a limit before; so this is at most the
        truth, and a hang on an overloaded machine is noticed later. Who still runs, and has run for
        a quarter of the limit since that was over, is slow by itself: then all of it is its own.

        Returns:
            The time, and after how much time another look will know more; 0 where this is known.
        """
        turns = _turns_of(self._words[_THREAD], now)
        if turns is None:  # a kernel that does not count: all of the time is its own
            return now - since, 0
        waited = max(0, turns.waited_ns - self._words[_DELAY])
        if not turns.ready:
            return now - since - waited, 0
        # It may have been ready for long without a turn, which is counted at its next one.
        first = self._looked[1] if self._looked and self._looked[0] == since else None
        if first is None:
            self._looked = (since, turns)
            return 0, _AGAIN_NS
        part = self._words[_LIMIT] // _SLOW_PARTS
        ran, counted = turns.ran_ns - first.ran_ns, turns.waited_ns - first.waited_ns
        if not ran and not counted:
            return 0, max(_AGAIN_NS, part)
        if ran >= part:
            return now - since, 0
        uncounted = max(0, turns.at_ns - first.at_ns - ran - counted)
        return now - since - waited - uncounted, part

    @property
    def busy_s(self) -> float:
        """Seconds that the holder has been busy; 0 if it is not."""
        since = self._words[_SINCE]
        return max(0.0, (time.monotonic_ns() - since) / _NS) if since else 0.0

    @property
    def what(self) -> str:
        """What the holder does, as it calls it; empty where it does not say."""
        text = bytes(self._memory[_WHAT : _WHAT + _WHAT_BYTES])
        return text.partition(b"\0")[0].decode(errors="replace")

    def where(self, pid: int) -> str:
        """Return where the threads of the holder stand, as faulthandler writes it.

        Waits for up to a quarter of a second.

        Args:
            pid: of the holder.

        Returns:
            Empty if it does not answer: it was stopped, or is not one of ours.
        """
        answers = pid > 0 and self._words[_ANSWERS]
        return stacks.ask(pid, self._page, _PAGE_BYTES) if answers else ""

    def close(self) -> None:
        """Close this side; again is harmless."""
        if self._timer < 0:
            return
        self._words.release()
        self._memory.close()
        os.close(self._timer)
        os.close(self._page)
        if self._turns >= 0:
            os.close(self._turns)
        self._timer = self._page = self._turns = -1

    def _note_turns(self) -> None:
        """Write into the page who the holder is, and for how long it has waited for processors."""
        if self._of_process:
            self._words[_THREAD] = -os.getpid()
            turns = _turns_of(-os.getpid(), 0)
            self._words[_DELAY] = turns.waited_ns if turns else 0
            return
        thread = threading.get_native_id()
        if thread != self._thread:
            self._thread = thread
            if self._turns >= 0:
                os.close(self._turns)
            self._turns = -1
            with contextlib.suppress(OSError):
                self._turns = os.open("/proc/thread-self/schedstat", os.O_RDONLY | os.O_CLOEXEC)
        if self._turns < 0:
            return
        counted = os.pread(self._turns, _STAT_BYTES, 0).split()
        self._words[_DELAY] = int(counted[1]) if len(counted) > 1 else 0
        self._words[_THREAD] = thread

    def _arm(self, ns: int) -> None:
        spec = TimerSpec.once(ns)
        self._set_time(self._timer, 0, ctypes.byref(spec), None)


def label(text: str) -> bytes:
    """Return what `BusySign.begin` takes."""
    return text.encode()[: _WHAT_BYTES - 1] + b"\0"


def _turns_of(thread: int, now: int) -> _Turns | None:
    """Read what a thread of this host had of the processors; None where that is not known.

    Of a process, a negative pid, it is what all of its threads waited together.
    """
    if thread < 0:
        folder = Path(f"/proc/{-thread}/task")
        try:
            every = [_turns_of(int(each.name), now) for each in folder.iterdir()]
        except OSError:
            return None
        waited = sum(each.waited_ns for each in every if each is not None)
        return _Turns(at_ns=now, ran_ns=0, waited_ns=waited, ready=False)
    try:
        counted = Path(f"/proc/{thread}/schedstat").read_bytes().split()
        state = Path(f"/proc/{thread}/stat").read_bytes().rpartition(b")")[2].split()[0]
        ran, waited = int(counted[0]), int(counted[1])
    except (OSError, IndexError, ValueError):
        return None
    if not ran:
        return None
    return _Turns(at_ns=now, ran_ns=ran, waited_ns=waited, ready=state == b"R")


@functools.lru_cache(maxsize=1)
def _set_time() -> typing.Any:
    pointer = ctypes.POINTER(TimerSpec)
    # It returns at once: keeping the interpreter's lock is cheaper than giving it up.
    function = ctypes.PyDLL(None).timerfd_settime
    function.argtypes = (ctypes.c_int, ctypes.c_int, pointer, pointer)
    function.restype = ctypes.c_int
    return function
