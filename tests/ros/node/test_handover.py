"""What is left of an endpoint whose connection was changed."""

from __future__ import annotations

import rclpy
from lifecycle_driver import Driver
from planning import built_with, planned, server
from std_srvs.srv import Trigger

from lifecycle import LifecycleNode, on_service


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
