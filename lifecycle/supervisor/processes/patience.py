"""Deadlines on a loaded machine: time that a process waits for a processor does not count.

Owns: `patient`, the wait with a limit that follows the load, and reading how long a process was
ready to run and did not. Fifty processes that start at once on two processors each need half a
second of work and have it after twenty: none of them hangs. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

SLICE_S = 1.0
"""How often is looked whether a process could run, while it is waited for."""

AT_MOST = 10.0
"""However loaded the machine is, a limit lasts no longer than so many times its seconds."""


async def patient(
    waits: Collection[asyncio.Future[Any]], limit_s: float, starved: Callable[[], float]
) -> bool:
    """Wait until one of some futures is done, or the limit is over; whether one is done.

    Args:
        waits: not cancelled here.
        limit_s: seconds, > 0, in which whom it is about can run. What it waits for a processor
            comes on top, up to `AT_MOST` times the limit in all.
        starved: seconds waited for a processor so far, of all threads together.
    """
    loop = asyncio.get_running_loop()
    began_s = now_s = loop.time()
    left_s = limit_s
    waited_s = starved()
    while left_s > 0 and now_s - began_s < AT_MOST * limit_s:
        done, _ = await asyncio.wait(
            waits, timeout=min(left_s, SLICE_S), return_when=asyncio.FIRST_COMPLETED
        )
        if done:
            return True
        before_s, now_s = now_s, loop.time()
        waited_before_s, waited_s = waited_s, starved()
        # Threads that wait at once have waited no longer for it, and one that ends takes its own
        # along.
        passed_s = now_s - before_s
        left_s -= passed_s - min(max(waited_s - waited_before_s, 0.0), passed_s)
    return any(each.done() for each in waits)


def starved_s(pid: int) -> float:
    """Return how long the threads of a process have waited for a processor, all together.

    Returns:
        Seconds, see "run delay" in sched-stats(Documentation/scheduler); 0 where the kernel does
        not count it or the process has ended.
    """
    total_ns = 0
    with contextlib.suppress(FileNotFoundError, ProcessLookupError, PermissionError):
        for thread in Path(f"/proc/{pid}/task").iterdir():
            total_ns += _run_delay_ns(f"{thread}/schedstat")
    return total_ns / 1e9


def own_starved_s() -> float:
    """Return how long this thread has waited for a processor, in seconds."""
    return _run_delay_ns("/proc/thread-self/schedstat") / 1e9


def _run_delay_ns(path: str) -> int:
    with contextlib.suppress(OSError, ValueError, IndexError):
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        try:
            return int(os.read(descriptor, 128).split()[1])
        finally:
            os.close(descriptor)
    return 0
