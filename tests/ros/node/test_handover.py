"""How long an endpoint lives on two connections, and what is left of the old one."""

from __future__ import annotations

from collections.abc import Callable

import rclpy
from lifecycle_driver import Driver
from planning import built_with, planned, server
from std_srvs.srv import Trigger

from lifecycle import LifecycleNode, on_service
from lifecycle.node.endpoints.handover import PATIENCE_S, SETTLE_S, Handover


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
    node.executor.wake()
    driver.settle()
    assert driver.state("/it") == (3, "active")
