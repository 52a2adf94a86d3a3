"""An ordinary rclpy action client beside the nodes under test, spun by their driver."""

from __future__ import annotations

from typing import Any

from lifecycle_driver import Driver
from rclpy.action import ActionClient
from rclpy.node import Node
from test_msgs.action import Fibonacci


class Asking:
    """Sends goals to one action, and notes feedback.

    Args:
        driver: whose node asks.
        action: fully qualified.
        server: the node whose participant the server is on; it must know the client, too, before a
            goal is sent, because an answer to a client that is not known is dropped.
    """

    def __init__(self, driver: Driver, action: str, server: Node) -> None:
        self.client = ActionClient(driver.node, Fibonacci, action)
        self.feedback: list[list[int]] = []
        self._driver = driver
        driver.spin_until(self.client.server_is_ready)
        driver.spin_until(lambda: knows_a_client(server, action))

    def goal(self, order: int = 1) -> Any:
        """Send a goal; return its handle, accepted or not."""
        future = self.client.send_goal_async(
            Fibonacci.Goal(order=order),
            feedback_callback=lambda message: self.feedback.append(list(message.feedback.sequence)),
        )
        self._driver.spin_until(future.done)
        return future.result()

    def result(self, goal: Any) -> tuple[int, list[int]]:
        """Wait for what a goal comes to; return its status and sequence."""
        future = goal.get_result_async()
        self._driver.spin_until(future.done)
        return future.result().status, list(future.result().result.sequence)

    def cancel(self, goal: Any) -> int:
        """Ask to cancel a goal; return how many goals will be."""
        future = goal.cancel_goal_async()
        self._driver.spin_until(future.done)
        return len(future.result().goals_canceling)

    def close(self) -> None:
        """Destroy the client."""
        self.client.destroy()


def knows_a_client(server: Node, action: str) -> bool:
    """Tell whether a node's participant has discovered all services of a client of an action."""
    services = ("send_goal", "cancel_goal", "get_result")
    return all(server.count_clients(f"{action}/_action/{each}") for each in services)
