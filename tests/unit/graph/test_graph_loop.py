"""Everything in one loop, one after another, and a wait that loses no cancellation."""

from __future__ import annotations

import asyncio
import threading

import pytest

from lifecycle.graph.loop import GraphLoop, set_within

LIMIT_S = 5.0


def test_a_thread_of_its_own_runs_what_is_posted_and_ends_with_its_coroutines() -> None:
    loop, done = GraphLoop(), threading.Event()
    ran: list[str] = []
    loop.post(lambda: ran.append(threading.current_thread().name))
    loop.post(done.set)
    assert done.wait(LIMIT_S)
    assert (ran, loop.has_thread) == (["graph"], True)
    waiting = asyncio.run_coroutine_threadsafe(asyncio.sleep(3600), loop.loop)
    loop.post(loop.close)  # from inside
    loop.close()
    loop.close()
    assert waiting.cancelled()
    assert "graph" not in [each.name for each in threading.enumerate()]
    loop.post(lambda: pytest.fail("the loop is closed"))


def test_a_loop_that_is_there_runs_what_is_posted_and_drops_what_comes_too_late() -> None:
    ran: list[str] = []

    async def use() -> GraphLoop:
        loop = GraphLoop(asyncio.get_running_loop())
        thread = threading.Thread(target=lambda: loop.post(lambda: ran.append("posted")))
        thread.start()
        thread.join()
        await asyncio.sleep(0.01)
        return loop

    loop = asyncio.run(use())
    assert (ran, loop.has_thread) == (["posted"], False)
    loop.post(lambda: pytest.fail("the loop is closed"))
    loop.close()


def test_an_event_that_is_set_ends_the_wait_and_one_that_is_not_ends_with_the_time() -> None:
    async def main() -> tuple[bool, bool, bool]:
        event, never = asyncio.Event(), asyncio.Event()
        asyncio.get_running_loop().call_soon(event.set)
        return (
            await set_within(event, None),
            await set_within(event, 0.0),
            await set_within(never, 0.0),
        )

    assert asyncio.run(main()) == (True, True, False)


@pytest.mark.parametrize("turns", range(5))
def test_a_cancellation_in_the_moment_of_the_event_is_not_lost(turns: int) -> None:
    async def forever(event: asyncio.Event) -> None:
        while True:
            await set_within(event, 1000.0)
            event.clear()

    async def main() -> bool:
        event = asyncio.Event()
        task = asyncio.ensure_future(forever(event))
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        event.set()
        for _ in range(turns):
            await asyncio.sleep(0)
        task.cancel()
        await asyncio.wait({task}, timeout=1.0)
        return task.cancelled()

    assert asyncio.run(main())
