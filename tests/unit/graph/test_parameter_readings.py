"""When the parameters of a foreign node are read, with services that do what they are told."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Collection

import pytest

from lifecycle.errors import MiddlewareError
from lifecycle.graph.loop import GraphLoop
from lifecycle.graph.readings import (
    AGAIN_AT_MOST_S,
    AGAIN_S,
    ANSWER_S,
    UNSHOWN_S,
    ParameterReadings,
)
from lifecycle.verify.observation import NodeParameters, ParameterReport
from tests.unit.supervisor.fakes import run

NAMED = {"/arm": frozenset({"gain"})}
NONE = NodeParameters(node="/arm", error="serves no parameters")
NO_ANSWER = NodeParameters(
    node="/arm", error=f"did not answer its parameter services within {ANSWER_S:g} s"
)


def gain(value: float) -> tuple[ParameterReport, ...]:
    return (ParameterReport(name="gain", type="double", value=value),)


def known(value: float) -> tuple[NodeParameters, ...]:
    return (NodeParameters(node="/arm", parameters=gain(value)),)


class Services:
    """Answers with `value`; hangs while that is None, and fails if it is an exception."""

    def __init__(self) -> None:
        self.serves: bool | None = True
        self.value: float | Exception | None = 1.5
        self.asked = 0
        self.listeners: list[Callable[[str, frozenset[str]], None]] = []

    def serves_parameters(self, node: str) -> bool | None:
        return self.serves

    async def report_parameters(
        self, node: str, names: Collection[str], *, timeout_s: float
    ) -> tuple[ParameterReport, ...]:
        self.asked += 1
        if self.value is None or self.serves is None:
            await asyncio.sleep(timeout_s)
            raise MiddlewareError("no answer")
        if isinstance(self.value, Exception):
            raise self.value
        return gain(self.value)

    def on_parameters(self, callback: Callable[[str, frozenset[str]], None]) -> None:
        self.listeners.append(callback)


class Reader:
    """Readings, and how often they woke whoever reads."""

    def __init__(self) -> None:
        self.services = Services()
        self.woken = 0
        loop = GraphLoop(asyncio.get_running_loop())
        self.readings = ParameterReadings(self.services, loop, self._wake)
        self.readings.listen(NAMED)

    def _wake(self) -> None:
        self.woken += 1

    async def read(self) -> tuple[NodeParameters, ...]:
        await self.readings.follow(["/arm"], reporting=())
        return self.readings.latest

    def event(self, node: str = "/arm", *names: str) -> None:
        for listener in self.services.listeners:
            listener(node, frozenset(names or ("gain",)))


def reading(test: Callable[[Reader], Awaitable[None]]) -> None:
    """Run a test with a reader in a loop whose clock jumps."""

    async def whole() -> None:
        reader = Reader()
        try:
            await test(reader)
        finally:
            reader.readings.close()
            await asyncio.sleep(0.01)  # its tasks end in the loop

    run(whole())


def test_a_look_waits_for_the_first_reading_and_for_no_other() -> None:
    async def test(reader: Reader) -> None:
        assert await reader.readings.follow(["/arm"], reporting=())
        assert not await reader.readings.follow(["/arm"], reporting=())
        assert reader.readings.latest == known(1.5)
        assert (reader.services.asked, reader.woken) == (1, 0)

    reading(test)


def test_an_event_that_names_a_judged_parameter_has_it_read_again() -> None:
    async def test(reader: Reader) -> None:
        await reader.read()
        reader.services.value = 99.0
        reader.event("/arm", "other")
        reader.event("/leg")
        await asyncio.sleep(0.1)
        assert await reader.read() == known(1.5)
        reader.event()
        await asyncio.sleep(0.1)
        assert await reader.read() == known(99.0)
        assert (reader.services.asked, reader.woken) == (2, 1)

    reading(test)


def test_what_no_event_tells_is_found_by_reading_again_ever_more_rarely() -> None:
    async def test(reader: Reader) -> None:
        await reader.read()
        await asyncio.sleep(10 * AGAIN_AT_MOST_S)
        assert 10 <= reader.services.asked <= 15
        assert reader.woken == 0
        reader.services.value = 2.0
        await asyncio.sleep(AGAIN_AT_MOST_S)
        assert await reader.read() == known(2.0)
        assert reader.woken == 1

    reading(test)


def test_a_parameter_that_changes_all_the_time_is_not_read_all_the_time() -> None:
    async def test(reader: Reader) -> None:
        await reader.read()
        for _ in range(1000):
            reader.event()
            await asyncio.sleep(0.001)
        assert reader.services.asked < 100

    reading(test)


def test_a_node_that_serves_no_parameters_is_not_waited_for() -> None:
    async def test(reader: Reader) -> None:
        reader.services.serves = False
        before = asyncio.get_running_loop().time()
        assert await reader.read() == (NONE,)
        assert asyncio.get_running_loop().time() == before
        assert reader.services.asked == 0

    reading(test)


def test_services_that_discovery_does_not_show_are_waited_for_a_moment() -> None:
    async def test(reader: Reader) -> None:
        reader.services.serves = None
        before = asyncio.get_running_loop().time()
        assert await reader.read() == (NONE,)
        assert asyncio.get_running_loop().time() - before == pytest.approx(UNSHOWN_S, abs=0.1)
        reader.services.serves = True
        await reader.read()  # the graph has changed: somebody looks
        await asyncio.sleep(0.1)
        assert await reader.read() == known(1.5)
        assert reader.woken == 1

    reading(test)


def test_a_node_that_does_not_answer_holds_up_one_look_only() -> None:
    async def test(reader: Reader) -> None:
        reader.services.value = None
        clock = asyncio.get_running_loop().time
        before = clock()
        assert await reader.read() == (NO_ANSWER,)
        assert clock() - before == pytest.approx(ANSWER_S, abs=0.1)
        before = clock()
        assert await reader.read() == (NO_ANSWER,)
        assert clock() == before
        reader.services.value = 1.5
        await asyncio.sleep(AGAIN_AT_MOST_S)
        assert await reader.read() == known(1.5)

    reading(test)


def test_a_node_that_is_busy_for_a_moment_is_what_it_was_unless_an_event_says_otherwise() -> None:
    async def test(reader: Reader) -> None:
        await reader.read()
        reader.services.value = None
        await asyncio.sleep(AGAIN_S + ANSWER_S + 0.5)
        assert await reader.read() == known(1.5)
        reader.event()
        await asyncio.sleep(ANSWER_S + 0.5)
        assert await reader.read() == (NO_ANSWER,)

    reading(test)


def test_a_node_that_answers_no_more_is_unknown_and_so_is_one_whose_services_are_gone() -> None:
    async def test(reader: Reader) -> None:
        await reader.read()
        reader.services.value = None
        await asyncio.sleep(3 * AGAIN_AT_MOST_S)
        assert await reader.read() == (NO_ANSWER,)
        reader.services.value = 1.5
        await asyncio.sleep(3 * AGAIN_AT_MOST_S)
        assert await reader.read() == known(1.5)
        reader.services.serves = False
        await asyncio.sleep(AGAIN_AT_MOST_S)
        assert await reader.read() == (NONE,)

    reading(test)


def test_an_answer_that_cannot_be_read_ends_nothing(caplog: pytest.LogCaptureFixture) -> None:
    async def test(reader: Reader) -> None:
        reader.services.value = ValueError("no such type")
        assert await reader.read() == (NO_ANSWER,)
        assert "no such type" in caplog.text
        reader.services.value = 1.5
        reader.event()
        await asyncio.sleep(0.1)
        assert await reader.read() == known(1.5)

    reading(test)


def test_a_node_that_left_or_reports_by_itself_is_read_no_more() -> None:
    async def test(reader: Reader) -> None:
        await reader.read()
        await reader.readings.follow([], reporting=["/arm"])
        assert reader.readings.latest == ()
        await reader.read()
        reader.readings.forget("/arm")
        asked = reader.services.asked
        await asyncio.sleep(5 * AGAIN_AT_MOST_S)
        assert reader.services.asked == asked
        reader.event()  # it reports by itself: somebody has to look
        await asyncio.sleep(0.1)
        assert reader.woken == 1

    reading(test)
