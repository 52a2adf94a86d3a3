"""Keeps networks programmed for as long as a supervisor runs, without ever holding up its loop.

Owns: when the blocking `Programmer` is called: for the latest flows only, again after a failure
with growing pauses, in time before something expires, and one last time to remove everything.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Coroutine, Iterator, Sequence
from typing import Any, Protocol, TypeVar

from lifecycle.errors import LifecycleError
from lifecycle.graph.waiting import set_within
from lifecycle.supervisor.programming.changes import Changes
from lifecycle.verify.verdict import FlowReport

_AGAIN_S = (2.0, 60.0)
"""First and longest pause after a failure."""

_SOON_S = 1.0
"""Nothing is renewed more often than so."""


class Programs(Protocol):
    """What a Programmer does for its keeper."""

    def update(self, flows: Sequence[FlowReport], *, hold: bool) -> tuple[Changes, ...]:
        """Bring networks up to date."""
        ...

    def renew(self) -> float | None:
        """Prolong what would expire; return seconds until the next time."""
        ...

    def close(self) -> tuple[Changes, ...]:
        """Remove everything."""
        ...


class Keeper:
    """Programs the latest flows, in a thread.

    Args:
        programmer: see Programs.
        tell: takes what was done and what failed, as text for people; called from the loop.
    """

    def __init__(self, programmer: Programs, tell: Callable[[str], None]) -> None:
        self._programmer = programmer
        self._tell = tell
        self._flows: tuple[FlowReport, ...] | None = None
        self._changed = asyncio.Event()
        self._task: asyncio.Task[None] | None = None

    async def begin(self, flows: Sequence[FlowReport]) -> None:
        """Program for the first time, and be done when this returns.

        Raises:
            LifecycleError: it failed; what was made all the same is removed by `close`.
        """
        self._flows = tuple(flows)
        texts, _ = await _whole(asyncio.to_thread(self._once))
        for text in texts:
            self._tell(text)
        self.take(flows)  # from now on renewed in time

    def take(self, flows: Sequence[FlowReport]) -> None:
        """Take the flows as just verified; flows that came before and were not done are skipped."""
        self._flows = tuple(flows)
        self._changed.set()
        if self._task is None:
            self._task = asyncio.ensure_future(self._run())

    async def close(self) -> None:
        """Stop, and remove from networks everything that is ours; failures are told."""
        task, self._task = self._task, None
        try:
            if task is not None:
                task.cancel()
                with contextlib.suppress(asyncio.CancelledError):
                    await task
        finally:
            with self._telling():
                for each in await asyncio.to_thread(self._programmer.close):
                    if each.changes:
                        self._tell(each.render(done=True))

    async def _run(self) -> None:
        pause_s: float | None = None
        again_s = _AGAIN_S[0]
        while True:
            await set_within(self._changed, pause_s)
            self._changed.clear()
            failed = True
            due_s = None
            with self._telling():
                texts, due_s = await _whole(asyncio.to_thread(self._once))
                for text in texts:
                    self._tell(text)
                failed = False
            again_s = min(again_s * 2, _AGAIN_S[1]) if failed else _AGAIN_S[0]
            pause_s = again_s if failed else due_s if due_s is None else max(due_s, _SOON_S)

    def _once(self) -> tuple[list[str], float | None]:
        assert self._flows is not None
        done = self._programmer.update(self._flows, hold=True)
        texts = [each.render(done=True) for each in done if each.pending]
        return texts, self._programmer.renew()

    @contextlib.contextmanager
    def _telling(self) -> Iterator[None]:
        try:
            yield
        except LifecycleError as error:
            self._tell(str(error))


_T = TypeVar("_T")


async def _whole(work: Coroutine[Any, Any, _T]) -> _T:
    """Wait for work in a thread to its end even when cancelled: it cannot be stopped half-way."""
    task = asyncio.ensure_future(work)
    try:
        return await asyncio.shield(task)
    except asyncio.CancelledError:
        await asyncio.gather(task, return_exceptions=True)
        raise
