"""Deadline and cancellation of blocking work on networks, from another thread or a signal.

Owns: `Deadline`, which everything shares that one Programmer calls. Pure but for its clock.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterator


class Deadline:
    """Until when work may go on, and whether it is to end at once; without end until `within`.

    Safe to use from any thread: one works, another cancels.

    Args:
        now_s: monotonic seconds.
    """

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._until_s = math.inf
        self._cancelled = False
        self._lock = threading.Lock()
        self._waits: set[threading.Event] = set()

    @contextlib.contextmanager
    def within(self, seconds: float | None) -> Iterator[None]:
        """Bound what is done inside; an outer bound holds as well.

        Args:
            seconds: from now; None sets no bound of its own. A negative one leaves no time.
        """
        outer_s = self._until_s
        if seconds is not None:
            self._until_s = min(outer_s, self._now_s() + seconds)
        try:
            yield
        finally:
            self._until_s = outer_s

    @property
    def is_cancelled(self) -> bool:
        """Whether it is to end at once."""
        return self._cancelled

    def left_s(self) -> float:
        """Return the seconds that are left: 0 if none are, infinity if there is no bound."""
        return 0.0 if self._cancelled else max(0.0, self._until_s - self._now_s())

    def cancel(self) -> None:
        """Leave no time, and wake whatever waits; holds until `renew`."""
        with self._lock:
            self._cancelled = True
            waits = tuple(self._waits)
        for each in waits:
            each.set()

    def renew(self) -> None:
        """Forget a `cancel`: what comes next is other work."""
        self._cancelled = False

    @contextlib.contextmanager
    def waking(self, event: threading.Event) -> Iterator[None]:
        """Have `cancel` set an event that is waited for inside."""
        with self._lock:
            self._waits.add(event)
            if self._cancelled:
                event.set()
        try:
            yield
        finally:
            with self._lock:
                self._waits.discard(event)
