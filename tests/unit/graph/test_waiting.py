"""Waiting for an event: what it returns, and that a cancellation always ends it."""

from __future__ import annotations

import asyncio

import pytest

from lifecycle.graph import set_within


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
