"""How long servers are waited for: how often is asked again, and when it is over.

Knows nothing of HTTP.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import threading
import time
from collections.abc import Coroutine, Iterator
from typing import Any, TypeVar

T = TypeVar("T")

_CANCEL_CHECK_S = 0.05


class Patience:
    """Bounds all that one programmer asks of servers; without end until `within`.

    One thread works, another cancels.

    Args:
        attempts: at most so many requests.
        first_s: wait before the second, then doubled each time.
        longest_s: longest single wait of our own choice.
        total_s: one request with all its attempts, and all waits between them; a Retry-After beyond
            it is not waited for.

    Attributes:
        cancelled: set while work is to end at once.
    """

    def __init__(
        self,
        *,
        attempts: int = 5,
        first_s: float = 0.5,
        longest_s: float = 8.0,
        total_s: float = 60.0,
    ) -> None:
        self.attempts, self.first_s = attempts, first_s
        self.longest_s, self.total_s = longest_s, total_s
        self._until_s = math.inf
        self.cancelled = threading.Event()

    def now_s(self) -> float:
        """Return seconds since the epoch."""
        return time.time()

    def steady_s(self) -> float:
        """Return seconds since the host was started, on a clock that only goes forward."""
        return time.clock_gettime(time.CLOCK_BOOTTIME)

    def sleep(self, seconds: float) -> None:
        """Wait, or until it is cancelled."""
        self.cancelled.wait(seconds)

    @contextlib.contextmanager
    def within(self, seconds: float | None) -> Iterator[None]:
        """Bound what is done inside; an outer bound holds as well.

        Args:
            seconds: from now; None sets no bound of its own. A negative one leaves no time.
        """
        outer_s = self._until_s
        if seconds is not None:
            self._until_s = min(outer_s, time.monotonic() + seconds)
        try:
            yield
        finally:
            self._until_s = outer_s

    def left_s(self) -> float:
        """Return the seconds that are left: 0 if none are, infinity if there is no bound."""
        return 0.0 if self.cancelled.is_set() else max(0.0, self._until_s - time.monotonic())

    def run(self, work: Coroutine[Any, Any, T], most_s: float) -> T:
        """Run a coroutine to its end, for as long as there is time.

        Args:
            work: cancelled once there is no time left, or whatever else ends this.
            most_s: for it alone, seconds.

        Raises:
            TimeoutError: there was no time left.
        """
        # Not asyncio.run, which waits for names that are still looked up.
        loop = asyncio.new_event_loop()
        task = loop.create_task(work)
        try:
            with self.within(most_s):
                loop.run_until_complete(self._bounded(task))
            if not task.done():
                raise TimeoutError
            return task.result()
        finally:
            if task.cancel():
                loop.run_until_complete(asyncio.wait([task]))
            loop.run_until_complete(loop.shutdown_asyncgens())  # of an answer that is cut off
            loop.close()

    async def _bounded(self, task: asyncio.Task[Any]) -> None:
        while not task.done() and (left_s := self.left_s()) > 0:
            await asyncio.wait({task}, timeout=min(left_s, _CANCEL_CHECK_S))
