"""How long two placements live side by side, and what their handler is given meanwhile."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import pytest
import rclpy
from lifecycle_driver import Driver
from planning import built_with, planned, server
from std_srvs.srv import Trigger

from lifecycle import LifecycleNode, on_service
from lifecycle.node.endpoints.placing import PATIENCE_S, SETTLE_S, Handover, Overlap


class Clock:
    """Timers that fire when the test says so."""

    def __init__(self) -> None:
        self.timers: dict[float, Callable[[], None]] = {}

    def after(self, delay_s: float, callback: Callable[[], None]) -> Callable[[], None]:
        self.timers[delay_s] = callback
        return lambda: self.timers.pop(delay_s, None)

    def fire(self, delay_s: float) -> None:
        self.timers.pop(delay_s)()


def begin(clock: Clock, *, peers_before: int) -> tuple[Handover, list[str]]:
    finished: list[str] = []
    handover = Handover(
        peers_before=peers_before, after=clock.after, finish=lambda: finished.append("finished")
    )
    return handover, finished


def test_the_old_one_goes_a_little_after_the_new_one_has_as_many_peers() -> None:
    clock = Clock()
    handover, finished = begin(clock, peers_before=2)
    handover.peers_changed(1)
    assert list(clock.timers) == [PATIENCE_S]
    handover.peers_changed(2)
    handover.peers_changed(3)
    assert list(clock.timers) == [SETTLE_S]
    assert not handover.done.done()
    clock.fire(SETTLE_S)
    assert handover.done.done()
    assert finished == ["finished"]
    handover.end()
    handover.peers_changed(2)
    assert finished == ["finished"]


def test_the_old_one_goes_when_patience_ends_without_peers() -> None:
    clock = Clock()
    handover, finished = begin(clock, peers_before=1)
    clock.fire(PATIENCE_S)
    assert handover.done.done()
    assert finished == ["finished"]
    assert clock.timers == {}


def info(number: int, writer: int = 0) -> dict[str, int]:
    return {"source_timestamp": 1000 * number + writer, "publication_sequence_number": number}


def test_each_sample_is_handed_on_once_and_in_the_old_ones_order() -> None:
    heard: list[str] = []
    overlap = Overlap(heard.append)
    overlap.from_new("2", info(2))  # by a faster way than the old one
    overlap.from_old("1", info(1))
    overlap.from_old("2", info(2))
    overlap.from_new("3", info(3))
    assert heard == ["1", "2"]
    overlap.release(give=None)
    assert heard == ["1", "2"]  # the gate was closed meanwhile
    overlap.from_new("4", info(4))
    overlap.release(give=lambda _: pytest.fail("it is not async"))
    overlap.alone("2", info(2))  # arrives late by the new one
    overlap.alone("5", info(5))
    assert heard == ["1", "2", "4", "5"]


def test_two_publishers_numbers_are_told_apart_by_their_times() -> None:
    heard: list[str] = []
    overlap = Overlap(heard.append)
    overlap.from_old("a1", info(1))
    overlap.from_new("b1", info(1, writer=7))
    overlap.release(give=lambda _: None)
    assert heard == ["a1", "b1"]


def test_async_handlers_that_take_the_info_are_awaited() -> None:
    heard: list[tuple[str, int]] = []

    async def handle(message: str, about: dict[str, int]) -> None:
        heard.append((message, about["publication_sequence_number"]))

    overlap = Overlap(handle)
    given: list[Any] = []
    overlap.from_new("1", info(1))
    overlap.from_new("2", info(2))

    async def run() -> None:
        await overlap.from_old("1", info(1))
        overlap.release(given.append)
        for each in given:
            await each
        await overlap.alone("1", info(1))
        await overlap.alone("3", info(3))

    asyncio.run(run())
    assert heard == [("1", 1), ("2", 2), ("3", 3)]


def test_an_answer_that_comes_after_its_server_was_unmade_is_lost_and_the_node_lives(
    driver: Driver, context: rclpy.Context
) -> None:
    class Slow(LifecycleNode):
        @on_service("ask")
        async def ask(self, request: Trigger.Request, response: Trigger.Response) -> None:
            self.asked = True
            await self.go_on

    with built_with(planned("it", server("ask")), context):
        node = Slow()
    node.asked = False
    node.go_on = rclpy.task.Future()
    driver.add(node)
    for label in ("configure", "connect", "activate"):
        assert driver.set("/it", label)
    driver.start(Trigger, "/ask", Trigger.Request())
    driver.spin_until(lambda: node.asked)
    node.map_to("ask", node.connect_to("udpv4://127.0.0.1", name="net"))
    node.go_on.set_result(None)
    node.lifecycle.wake()
    driver.settle()
    assert driver.state("/it") == (3, "active")
