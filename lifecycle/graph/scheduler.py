"""Schedulers, deadlines and timers of the graph interface: one place for all that runs.

Owns: the Scheduler Protocol and its two kinds, many deadlines of equal length with one timer, and
a wait for an event that loses no cancellation. Whatever a layer does, and every callback that it
calls, runs in its scheduler, one after another and never two at once; so a subscriber needs no lock
against another. A scheduler sleeps until it is given something or something is due. Pure.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
import typing
from collections import OrderedDict
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


@typing.final
class LoopScheduler:
    """Runs everything in an asyncio loop; `post` from any thread, the rest from the loop's.

    What is posted after the loop was closed is dropped.

    Args:
        loop: None: the one in which the scheduler is first used; what other threads post before
            that waits for it.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop | None = None) -> None:
        self._loop = loop
        self._lock = threading.Lock()
        self._early: list[Work] = []

    def now_s(self) -> float:
        """Return the loop's time."""
        return self._bound().time()

    def post(self, work: Work) -> None:
        """Run `work` in the loop's next turn."""
        with contextlib.suppress(RuntimeError):
            self._bound()
        with self._lock:
            if self._loop is None:
                self._early.append(work)
                return
        with contextlib.suppress(RuntimeError):  # the loop was closed meanwhile
            self._loop.call_soon_threadsafe(_logged, work)

    def call_at(self, when_s: float, work: Work) -> Remove:
        """Run `work` as `loop.call_at` does."""
        return self._bound().call_at(when_s, _logged, work).cancel

    def _bound(self) -> asyncio.AbstractEventLoop:
        """Return the loop; raise RuntimeError if there is none yet and none runs here."""
        if self._loop is None:
            loop = asyncio.get_running_loop()
            with self._lock:
                self._loop, early = loop, self._early
                self._early = []
                for work in early:
                    loop.call_soon(_logged, work)
        return self._loop


@typing.final
class ThreadScheduler:
    """Runs everything in an asyncio loop in one thread of its own.

    Every method: any thread. `close` it in the end.

    Attributes:
        loop: for coroutines that are to run there too; `close` cancels them.
    """

    def __init__(self, name: str = "graph") -> None:
        self.loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def now_s(self) -> float:
        """Return the loop's time."""
        return self.loop.time()

    def post(self, work: Work) -> None:
        """Run `work` in the thread; dropped after `close`."""
        with contextlib.suppress(RuntimeError):  # the loop is closed
            self.loop.call_soon_threadsafe(_logged, work)

    def call_at(self, when_s: float, work: Work) -> Remove:
        """Run `work` in the thread at `when_s`."""
        entry = [work]

        def run() -> None:
            if entry:
                _logged(entry.pop())

        def begin() -> None:
            self.loop.call_at(when_s, run)

        self.post(begin)
        return entry.clear

    def close(self) -> None:
        """End the thread; waits for what runs now, unless it is called there."""
        with contextlib.suppress(RuntimeError):  # it is closed already
            self.loop.call_soon_threadsafe(self.loop.stop)
        if self._thread is not threading.current_thread():
            self._thread.join()

    def _run(self) -> None:
        try:
            self.loop.run_forever()
            tasks = asyncio.all_tasks(self.loop)
            for each in tasks:
                each.cancel()
            if tasks:
                self.loop.run_until_complete(asyncio.wait(tasks))
        finally:
            self.loop.close()


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
        """Restart the deadline of `name`."""
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
    outlives its cancellation, and who waits for its end waits for ever.
    """
    waiting = asyncio.ensure_future(event.wait())
    try:
        done, _ = await asyncio.wait({waiting}, timeout=timeout_s)
    finally:
        waiting.cancel()
    return bool(done)
