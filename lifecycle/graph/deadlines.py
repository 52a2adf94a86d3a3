"""Many deadlines of equal length with one timer: who was not heard of for so long?

Owns: the deadlines of a set of names. Hearing of one costs the same whatever their number, and the
timer wakes only for the one that is due first. Pure.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable

from lifecycle.graph.scheduler import Scheduler
from lifecycle.graph.transport import Remove


class Deadlines:
    """Calls `passed` with each name that was not touched for `after_s`; then it is dropped.

    To be used in the scheduler only.
    """

    def __init__(self, scheduler: Scheduler, after_s: float, passed: Callable[[str], None]) -> None:
        self._scheduler = scheduler
        self._after_s = after_s
        self._passed = passed
        self._touched_s: OrderedDict[str, float] = OrderedDict()
        self._cancel: Remove | None = None

    def touch(self, name: str) -> None:
        """Begin the deadline of `name` anew."""
        self._touched_s[name] = self._scheduler.now_s()
        self._touched_s.move_to_end(name)
        self._arm()

    def drop(self, name: str) -> None:
        """Forget `name`; the timer finds out by itself."""
        self._touched_s.pop(name, None)

    def close(self) -> None:
        """Forget all."""
        self._touched_s.clear()
        if self._cancel is not None:
            self._cancel()

    def _arm(self) -> None:
        if self._cancel is None and self._touched_s:
            first_s = next(iter(self._touched_s.values()))
            self._cancel = self._scheduler.call_at(first_s + self._after_s, self._check)

    def _check(self) -> None:
        self._cancel = None
        now_s = self._scheduler.now_s()
        while self._touched_s:
            name, touched_s = next(iter(self._touched_s.items()))
            if touched_s + self._after_s > now_s:
                break
            del self._touched_s[name]
            self._passed(name)
        self._arm()
