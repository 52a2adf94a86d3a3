"""Everything in one place, one after another, and a wait that loses no cancellation."""

from __future__ import annotations

import asyncio
import logging
import threading

import pytest
from simulated import ManualScheduler

from lifecycle.graph.scheduler import Deadlines, LoopScheduler, ThreadScheduler, set_within

LIMIT_S = 5.0


def test_a_thread_runs_posts_and_timers_and_survives_an_exception(
    caplog: pytest.LogCaptureFixture,
) -> None:
    scheduler, done = ThreadScheduler("test"), threading.Event()
    ran: list[str] = []

    def fail() -> None:
        raise ValueError("mine")

    with caplog.at_level(logging.ERROR):
        scheduler.post(fail)
        scheduler.post(lambda: ran.append(threading.current_thread().name))
        scheduler.call_at(scheduler.now_s() + 0.01, lambda: ran.append("never"))()
        scheduler.call_at(scheduler.now_s() + 0.02, done.set)
        assert done.wait(LIMIT_S)
    assert ran == ["test"]
    assert caplog.messages == ["cannot handle a graph event"]
    scheduler.post(scheduler.close)  # from inside
    scheduler.close()
    scheduler.close()
    assert "test" not in [each.name for each in threading.enumerate()]


def test_a_loop_runs_what_other_threads_post_and_drops_what_comes_too_late() -> None:
    async def posted() -> str:
        loop = asyncio.get_running_loop()
        scheduler, found = LoopScheduler(loop), loop.create_future()
        scheduler.call_at(scheduler.now_s() + 0.001, lambda: found.set_result("never"))()
        thread = threading.Thread(
            target=lambda: scheduler.post(lambda: found.set_result(threading.current_thread().name))
        )
        thread.start()
        thread.join()
        schedulers.append(scheduler)
        return str(await asyncio.wait_for(found, LIMIT_S))

    schedulers: list[LoopScheduler] = []
    assert asyncio.run(posted()) == threading.current_thread().name
    schedulers[0].post(lambda: pytest.fail("the loop is closed"))


class Counting:
    """A manual scheduler that counts how often it was asked to wake up."""

    def __init__(self) -> None:
        self.manual = ManualScheduler()
        self.timers = 0
        self.now_s = self.manual.now_s
        self.post = self.manual.post

    def call_at(self, when_s: float, work: object) -> object:
        self.timers += 1
        return self.manual.call_at(when_s, work)  # type: ignore[arg-type]


def test_many_deadlines_take_one_timer_and_few_wake_ups() -> None:
    scheduler, passed = Counting(), []
    deadlines = Deadlines(
        scheduler,  # type: ignore[arg-type]
        7.0,
        lambda name: passed.append((name, scheduler.now_s())),
    )
    names = [f"/n{number}" for number in range(1000)]
    for _ in range(10):
        for name in names:
            deadlines.touch(name)
        scheduler.manual.advance(2.0)
    assert passed == []
    assert scheduler.timers <= 5
    for name in names[1:]:
        deadlines.drop(name)
    scheduler.manual.advance(100.0)
    assert passed == [("/n0", 25.0)]


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


def test_what_is_posted_before_there_is_a_loop_waits_for_it() -> None:
    scheduler, ran = LoopScheduler(), []
    scheduler.post(lambda: ran.append("early"))

    async def use() -> None:
        scheduler.post(lambda: ran.append("late"))
        await asyncio.sleep(0)

    asyncio.run(use())
    assert ran == ["early", "late"]


def test_a_thread_that_ends_cancels_the_coroutines_that_run_in_it() -> None:
    scheduler = ThreadScheduler("test")
    waiting = asyncio.run_coroutine_threadsafe(asyncio.sleep(3600), scheduler.loop)
    scheduler.close()
    assert waiting.cancelled()
