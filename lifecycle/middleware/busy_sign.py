"""A sign that says since when one process is busy, and a kernel timer that wakes who watches it.

Owns: the page of memory and the timerfd(2) that the two processes share. The busy one writes the
time of day into the page, which costs less than a microsecond and no system call; it arms the timer
no more than once per limit. The watcher sleeps until the timer fires and then looks at the page. So
while the one is idle nobody wakes up, and neither the lock of an interpreter, nor a blocked thread,
nor SIGSTOP keeps the other from noticing. Must not import rclpy.

Python has timerfd from 3.13 on; until then it is called through ctypes.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import mmap
import os
import time
import typing

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.libc import CLOCK_MONOTONIC, TimerSpec, libc

_TFD_NONBLOCK = 0o4000
_TFD_CLOEXEC = 0o2000000
_COUNT_BYTES = 8
_PAGE_BYTES = mmap.PAGESIZE
_SINCE = 0
_LIMIT = 1
_NS = 1_000_000_000
_LEAST_NS = 1_000_000
"""A timer armed with 0 would be off."""


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
        self._set_time = _set_time()

    @classmethod
    def make(cls, limit_s: float) -> BusySign:
        """Make a sign whose holder may be busy for `limit_s` seconds, > 0, at a time.

        Raises:
            MiddlewareError: the kernel refused.
        """
        timer = libc().timerfd_create(CLOCK_MONOTONIC, _TFD_NONBLOCK | _TFD_CLOEXEC)
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

    def begin(self) -> None:
        """Be busy from now on."""
        words = self._words
        words[_SINCE] = time.monotonic_ns()
        # Read anew, after the page says busy: whoever wakes when the timer fires must see it.
        now = time.monotonic_ns()
        if now >= self._armed_until:
            limit = words[_LIMIT]
            self._armed_until = now + limit
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

    def overdue(self) -> bool:
        """Return whether the holder has been busy beyond its limit; else look again in time."""
        with contextlib.suppress(BlockingIOError):
            os.read(self._timer, _COUNT_BYTES)
        # The time first: what the holder measures itself is then never less.
        now = time.monotonic_ns()
        since = self._words[_SINCE]
        if not since:
            return False
        left = since + self._words[_LIMIT] - now
        if left > 0:
            self._arm(max(left, _LEAST_NS))
        return left <= 0

    def close(self) -> None:
        """Close this side; again is harmless."""
        if self._timer < 0:
            return
        self._words.release()
        self._memory.close()
        os.close(self._timer)
        os.close(self._page)
        self._timer = self._page = -1

    def _arm(self, ns: int) -> None:
        spec = TimerSpec.once(ns)
        self._set_time(self._timer, 0, ctypes.byref(spec), None)


@functools.lru_cache(maxsize=1)
def _set_time() -> typing.Any:
    pointer = ctypes.POINTER(TimerSpec)
    # It returns at once: keeping the interpreter's lock is cheaper than giving it up.
    function = ctypes.PyDLL(None).timerfd_settime
    function.argtypes = (ctypes.c_int, ctypes.c_int, pointer, pointer)
    function.restype = ctypes.c_int
    return function
