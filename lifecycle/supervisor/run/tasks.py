"""Running things side by side so that the first failure ends them all.

Owns: `together`, what asyncio.TaskGroup does, which Python 3.10 does not have, `ended`, and
`Worker`, a thread for what blocks. Pure.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

from lifecycle.middleware.process.control import no_room_for_threads

T = TypeVar("T")

_AGAIN_S = 1.0
"""Far longer than any task takes to notice that it was cancelled."""


async def ended(*tasks: asyncio.Future[Any]) -> None:
    """Cancel tasks and wait until each has ended, however it did.

    They are cancelled again and again: asyncio.wait_for of Python 3.10 and 3.11 may take a
    cancellation for the end of its wait (python/cpython#86296).
    """
    while left := [each for each in tasks if not each.done()]:
        for each in left:
            each.cancel()
        await asyncio.wait(left, timeout=_AGAIN_S)
    await asyncio.gather(*tasks, return_exceptions=True)


async def together(coroutines: Iterable[Coroutine[Any, Any, None]]) -> None:
    """Run all at once; the first exception cancels the others and is raised.

    Nothing is still running when it returns, whichever way.
    """
    tasks = [asyncio.ensure_future(each) for each in coroutines]
    if not tasks:
        return
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_EXCEPTION)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    # In the order given, so that a failure is the same from run to run where two come at once.
    for task in tasks:
        if task in done and not task.cancelled() and (error := task.exception()) is not None:
            raise error


class Worker:
    """A thread for what blocks, one thing after the other.

    It is started at once: a system that has reached its limit of processes and threads must still
    be taken down (asyncio's own executor starts a thread when it is used, and one to end).

    Raises:
        MiddlewareError: no thread can be started.
    """

    def __init__(self, name: str) -> None:
        self._executor = ThreadPoolExecutor(1, thread_name_prefix=name)
        try:
            self._executor.submit(int)
        except RuntimeError as error:
            raise no_room_for_threads(1) from error

    async def run(self, work: Callable[..., T], *arguments: object) -> T:
        """Do `work` in the thread, and return what it returns."""
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._executor, work, *arguments)

    def close(self) -> None:
        """Finish what is under way, and end the thread."""
        self._executor.shutdown()
