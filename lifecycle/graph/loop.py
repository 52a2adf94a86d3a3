"""The asyncio loop in which a graph runs, and waits that lose no cancellation.

Owns: where callbacks of a graph are called, one after another; `set_within`, `ended`, `within`.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
import typing
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar


@typing.final
class GraphLoop:
    """Runs what it is given in one asyncio loop, in order.

    Args:
        loop: None has one in a thread of its own.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop | None = None) -> None:
        self.loop = loop or asyncio.new_event_loop()
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._closed = False
        if loop is None:
            self._thread = threading.Thread(target=self._run, name="graph", daemon=True)
            self._thread.start()

    @property
    def has_thread(self) -> bool:
        """Whether the loop has a thread of its own."""
        return self._thread is not None

    def post(self, work: Callable[[], object]) -> None:
        """Run `work` in the loop soon; from any thread. Dropped once the loop is closed."""
        with contextlib.suppress(RuntimeError):
            self.loop.call_soon_threadsafe(work)

    def close(self) -> None:
        """End the thread, if there is one, and cancel what runs in it; again is harmless."""
        if self._thread is None:
            return
        with self._lock:
            closed, self._closed = self._closed, True
        if not closed:
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


async def set_within(event: asyncio.Event, timeout_s: float | None) -> bool:
    """Wait until `event` is set; False if it was not within `timeout_s` (None: no limit).

    asyncio.wait_for of Python 3.10 and 3.11 returns normally when it is cancelled in the moment in
    which what it waits for comes true (python/cpython#86296): a task that waits in a loop then
    outlives its cancellation.
    """
    waiting = asyncio.ensure_future(event.wait())
    try:
        done, _ = await asyncio.wait({waiting}, timeout=timeout_s)
    finally:
        waiting.cancel()
    return bool(done)


T = TypeVar("T")

_AGAIN_S = 5.0
"""Far longer than any task takes to notice that it was cancelled, also on a loaded machine."""

_TIMES = 6
"""A task that does not end then is left behind: nobody may wait for it for ever."""


async def ended(*tasks: asyncio.Future[Any]) -> None:
    """Cancel tasks and wait until each has ended, however it did, also if this is cancelled.

    They are cancelled again, bounded: asyncio.wait_for of Python 3.10 and 3.11 may take a
    cancellation for the end of its wait (python/cpython#86296).
    """
    cancelled: asyncio.CancelledError | None = None
    for _ in range(_TIMES):
        if not (left := [each for each in tasks if not each.done()]):
            break
        for each in left:
            each.cancel()
        try:
            await asyncio.wait(left, timeout=_AGAIN_S)
        except asyncio.CancelledError as error:
            cancelled = error
    await asyncio.gather(*(each for each in tasks if each.done()), return_exceptions=True)
    if cancelled is not None:
        raise cancelled


async def within(seconds: float, work: Coroutine[Any, Any, T]) -> T:
    """Carry something out in a task of its own, for so long; nothing of it runs on afterwards.

    asyncio.wait_for gives up what it waits for if it is cancelled a second time.

    Raises:
        asyncio.TimeoutError: it took longer.
    """
    task = asyncio.ensure_future(work)
    try:
        done, _ = await asyncio.wait((task,), timeout=seconds)
    finally:
        await ended(task)
    if not task.done() or (not done and task.cancelled()):
        raise asyncio.TimeoutError
    return task.result()
