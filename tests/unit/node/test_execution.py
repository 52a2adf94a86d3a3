"""Callbacks: what they return, what they raise, how long they take."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Generator
from typing import Any

import pytest

from lifecycle.errors import LifecycleError
from lifecycle.node.callbacks import (
    CallbackOutcome,
    DeadlineError,
    Result,
    Running,
    called,
    result_of,
)

WHAT = "/camera: on_configure"


class Never:
    """Awaits for ever, as a service that nobody serves does."""

    def __await__(self) -> Generator[None, None, None]:
        while True:
            yield


def drive(
    callback: Callable[..., Any],
    *,
    deadline_s: float = 10.0,
    turns: int = 3,
    interruption: LifecycleError | None = None,
) -> Result:
    """Run a callback as an executor does: resume it at each turn; interrupt it after the first."""
    running = Running(called(callback, "state"))
    coroutine = result_of(running, what=WHAT, deadline_s=deadline_s)
    for _ in range(turns):
        try:
            coroutine.send(None)
        except StopIteration as stop:
            result: Result = stop.value
            return result
        if interruption is not None:
            running.interrupt(interruption)
    coroutine.close()
    raise AssertionError(f"still running after {turns} turns")


LATE = DeadlineError("it is late")


@pytest.mark.parametrize(
    ("returned", "outcome"),
    [
        (None, CallbackOutcome.SUCCESS),
        (CallbackOutcome.SUCCESS, CallbackOutcome.SUCCESS),
        (CallbackOutcome.FAILURE, CallbackOutcome.FAILURE),
        (CallbackOutcome.ERROR, CallbackOutcome.ERROR),
        (True, CallbackOutcome.ERROR),
        ("SUCCESS", CallbackOutcome.ERROR),
        (0, CallbackOutcome.ERROR),
        (Exception, CallbackOutcome.ERROR),
    ],
)
def test_what_a_callback_returns_decides(returned: object, outcome: CallbackOutcome) -> None:
    assert drive(lambda: returned).outcome is outcome


def test_awaiting_asyncio_says_that_there_is_no_loop_and_what_to_await() -> None:
    async def naps(state: str) -> None:
        await asyncio.sleep(0.1)

    result = drive(naps)
    assert result.outcome is CallbackOutcome.ERROR
    assert result.error == (
        "/camera: on_configure raised RuntimeError: no running event loop; callbacks run in "
        "rclpy's executor, which has no asyncio loop: await what rclpy gives, as "
        "client.call_async(request) does, and wait by self.sleep(seconds)"
    )


def test_an_async_callback_is_resumed_until_it_returns() -> None:
    turns: list[int] = []

    class Twice:
        def __await__(self) -> Generator[None, None, None]:
            for turn in range(2):
                turns.append(turn)
                yield

    async def on_configure() -> CallbackOutcome:
        await Twice()
        return CallbackOutcome.FAILURE

    assert drive(on_configure).outcome is CallbackOutcome.FAILURE
    assert turns == [0, 1]


def test_an_async_callback_beyond_its_deadline_is_interrupted_where_it_awaits() -> None:
    ended: list[str] = []

    async def on_configure() -> None:
        try:
            await Never()  # a calibration service that never answers
        finally:
            ended.append("finally")

    result = drive(on_configure, interruption=LATE)
    assert result.outcome is CallbackOutcome.ERROR
    assert result.error == "it is late"
    assert "a calibration service that never answers" in result.trace
    assert ended == ["finally"]


def test_a_callback_that_swallows_its_interruption_is_ended_all_the_same() -> None:
    async def on_configure() -> None:
        while True:
            try:
                await Never()
            except Exception:  # noqa: BLE001, PERF203
                continue

    result = drive(on_configure, interruption=LATE)
    assert result.outcome is CallbackOutcome.ERROR
    assert result.error == "it is late"


def test_a_callback_that_answers_its_interruption_has_not_succeeded() -> None:
    async def on_configure() -> CallbackOutcome:
        try:
            await Never()
        except DeadlineError:
            return CallbackOutcome.SUCCESS
        return CallbackOutcome.FAILURE

    result = drive(on_configure, interruption=LATE)
    assert (result.outcome, result.error) == (CallbackOutcome.ERROR, "it is late")


def test_a_callback_that_interrupts_itself_goes_on() -> None:
    async def on_configure() -> None:
        running.interrupt(LATE)

    running = Running(called(on_configure))
    with pytest.raises(StopIteration) as stop:
        result_of(running, what=WHAT, deadline_s=10.0).send(None)
    assert stop.value.value.outcome is CallbackOutcome.SUCCESS


def test_a_sync_callback_beyond_its_deadline_is_an_error_that_says_what_to_do() -> None:
    result = drive(lambda: None, deadline_s=0.0)
    assert result.outcome is CallbackOutcome.ERROR
    assert result.error == (
        "cannot accept /camera: on_configure: it blocked for 0.0 s, its deadline is 0 s; "
        "make it `async def` so that it can be interrupted"
    )


@pytest.mark.parametrize("ending", [KeyboardInterrupt, asyncio.CancelledError])
def test_what_ends_more_than_a_callback_is_not_swallowed(ending: type[BaseException]) -> None:
    def on_configure() -> None:
        raise ending

    with pytest.raises(ending):
        drive(on_configure)
