"""Notices that this process stood still: it was stopped or frozen, or its machine slept.

Owns: `Standstill`. What arrives meanwhile waits in the kernel, and the threads of the middleware
need a moment to take it in, so no verdict of before is one of now.
"""

from __future__ import annotations

import asyncio
import time

_BEAT_S = 0.1
STILL_S = 0.25
"""A loop without a turn for so long, which did not compute either, stood still."""


class Standstill:
    """Counts for how often the running loop stood still; `close` it."""

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._count = 0
        self._last_s, self._cpu_s = _now_s(), time.thread_time()
        self._timer = self._loop.call_later(_BEAT_S, self._beat)

    def count(self) -> int:
        """Return how often it stood still until this very moment; call it in the loop."""
        now_s, cpu_s = _now_s(), time.thread_time()
        if now_s - self._last_s - (cpu_s - self._cpu_s) > STILL_S:
            self._count += 1
        self._last_s, self._cpu_s = now_s, cpu_s
        return self._count

    def close(self) -> None:
        """Notice nothing more."""
        self._timer.cancel()

    def _beat(self) -> None:
        self.count()
        self._timer = self._loop.call_later(_BEAT_S, self._beat)


def _now_s() -> float:
    """Return the time of CLOCK_BOOTTIME, which also goes on while the machine sleeps."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)
