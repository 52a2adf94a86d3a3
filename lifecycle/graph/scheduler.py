"""Time and threads for the graph interface: one place where everything runs.

Owns: the Scheduler Protocol and its three kinds, many deadlines of equal length with one timer, and
a wait for an event that loses no cancellation. Whatever a layer does, and every callback that it
calls, runs in its scheduler, one after another and never two at once; so a subscriber needs no lock
against another. A scheduler sleeps until it is given something or something is due. Pure.
"""

from __future__ import annotations

import asyncio
import contextlib
import heapq
import itertools
import logging
import threading
import time
import typing
from collections import OrderedDict, deque
from collections.abc import Callable
from typing import Protocol

_logger = logging.getLogger(__name__)

Work = Callable[[], None]

Remove = Callable[[], None]
"""Takes a callback away again; a second call does nothing."""


class Scheduler(Protocol):
    """Runs what it is given, one after another, in the order in which it was given or came due."""

    def now_s(self) -> float:
        """Return the time, in seconds since any fixed moment; it never goes back."""

    def post(self, work: Work) -> None:
        """Run `work` soon; any thread. An exception that it raises is logged."""

    def call_at(self, when_s: float, work: Work) -> Remove:
        """Run `work` at `when_s` or soon after, unless what is returned is called before."""


def every(scheduler: Scheduler) -> Callable[[float, Work], Remove]:
    """Return a periodic timer (`lifecycle.graph.Every`) that runs in `scheduler`.

    A period that was missed is not made up for.
    """

    def start(period_s: float, work: Work) -> Remove:
        cancel: list[Remove] = []
        stopped = False

        def run() -> None:
            if stopped:
                return
            cancel[:] = [scheduler.call_at(scheduler.now_s() + period_s, run)]
            work()

        def stop() -> None:
            nonlocal stopped
            stopped = True
            for each in cancel:
                each()

        cancel.append(scheduler.call_at(scheduler.now_s() + period_s, run))
        return stop

    return start


class _Timers:
    """What is due when. Not thread-safe."""

    def __init__(self) -> None:
        self._heap: list[tuple[float, int, list[Work]]] = []
        self._count = itertools.count()

    def add(self, when_s: float, work: Work) -> list[Work]:
        """Return the entry; emptying it cancels it."""
        entry = [work]
        heapq.heappush(self._heap, (when_s, next(self._count), entry))
        return entry

    def next_s(self) -> float | None:
        """Return when something is due; None if nothing ever is."""
        while self._heap and not self._heap[0][2]:
            heapq.heappop(self._heap)
        return self._heap[0][0] if self._heap else None

    def pop_due(self, now_s: float) -> Work | None:
        """Take out the first that is due."""
        when_s = self.next_s()
        if when_s is None or when_s > now_s:
            return None
        return heapq.heappop(self._heap)[2].pop()


@typing.final
class ManualScheduler:
    """Time that moves only when it is told to: for tests and simulations. One thread.

    What is posted runs at once, unless something runs already: then after that.
    """

    def __init__(self) -> None:
        self._now_s = 0.0
        self._timers = _Timers()
        self._posted: deque[Work] = deque()
        self._running = False

    def now_s(self) -> float:
        """Return the seconds that `advance` has added up."""
        return self._now_s

    def post(self, work: Work) -> None:
        """Run `work` now, or after what runs now."""
        self._posted.append(work)
        if self._running:
            return
        self._running = True
        try:
            while self._posted:
                self._posted.popleft()()
        finally:
            self._running = False
            self._posted.clear()

    def call_at(self, when_s: float, work: Work) -> Remove:
        """Run `work` when `advance` gets there."""
        return self._timers.add(when_s, work).clear

    def advance(self, seconds: float) -> None:
        """Let time pass, >= 0, and run what comes due in its order. An exception ends it."""
        end_s = self._now_s + seconds
        while (due_s := self._timers.next_s()) is not None and due_s <= end_s:
            self._now_s = max(self._now_s, due_s)
            work = self._timers.pop_due(due_s)
            assert work is not None
            self.post(work)
        self._now_s = end_s


@typing.final
class LoopScheduler:
    """Runs everything in an asyncio loop; `post` from any thread, the rest from the loop's.

    What is posted after the loop was closed is dropped: nobody is left to care.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop

    def now_s(self) -> float:
        """Return the loop's time."""
        return self._loop.time()

    def post(self, work: Work) -> None:
        """Run `work` in the loop's next turn."""
        with contextlib.suppress(RuntimeError):  # the loop was closed meanwhile
            self._loop.call_soon_threadsafe(_logged, work)

    def call_at(self, when_s: float, work: Work) -> Remove:
        """Run `work` as `loop.call_at` does."""
        return self._loop.call_at(when_s, _logged, work).cancel


@typing.final
class ThreadScheduler:
    """Runs everything in one thread of its own. Every method: any thread. `close` it in the end."""

    def __init__(self, name: str = "graph") -> None:
        self._wake = threading.Condition()
        self._timers = _Timers()
        self._posted: deque[Work] = deque()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def now_s(self) -> float:
        """Return `time.monotonic`."""
        return time.monotonic()

    def post(self, work: Work) -> None:
        """Run `work` in the thread; dropped after `close`."""
        with self._wake:
            self._posted.append(work)
            self._wake.notify()

    def call_at(self, when_s: float, work: Work) -> Remove:
        """Run `work` in the thread at `when_s`."""
        with self._wake:
            entry = self._timers.add(when_s, work)
            self._wake.notify()

        def remove() -> None:
            with self._wake:
                entry.clear()

        return remove

    def close(self) -> None:
        """End the thread; waits for what runs now, unless that is who calls."""
        with self._wake:
            self._closed = True
            self._wake.notify()
        if self._thread is not threading.current_thread():
            self._thread.join()

    def _run(self) -> None:
        while (work := self._next()) is not None:
            _logged(work)

    def _next(self) -> Work | None:
        with self._wake:
            while not self._closed:
                if self._posted:
                    return self._posted.popleft()
                if (due := self._timers.pop_due(time.monotonic())) is not None:
                    return due
                next_s = self._timers.next_s()
                self._wake.wait(None if next_s is None else max(0.0, next_s - time.monotonic()))
            return None


def _logged(work: Work) -> None:
    try:
        work()
    except Exception:
        _logger.exception("cannot handle a graph event")


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


async def set_within(event: asyncio.Event, timeout_s: float | None) -> bool:
    """Wait until `event` is set; False if it was not within `timeout_s` (None: no limit).

    asyncio.wait_for of Python 3.10 and 3.11 returns normally when it is cancelled in the moment in
    which what it waits for comes true (python/cpython#86296): a task that waits in a loop then
    outlives its cancellation, and whoever waits for its end waits for ever.
    """
    waiting = asyncio.ensure_future(event.wait())
    try:
        done, _ = await asyncio.wait({waiting}, timeout=timeout_s)
    finally:
        waiting.cancel()
    return bool(done)
