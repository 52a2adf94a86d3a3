"""A node that counts for others, step by step, and the endpoints of such nodes."""

from __future__ import annotations

from typing import Any

from action_msgs.msg import GoalStatus
from lifecycle_driver import Driver
from rclpy.task import Future
from test_msgs.action import Fibonacci

from lifecycle import LifecycleNode, on_action
from lifecycle.manifest.model import EndpointKind
from tests.builders import planned_endpoint

TYPE = "test_msgs/action/Fibonacci"
SUCCEEDED = GoalStatus.STATUS_SUCCEEDED
CANCELED = GoalStatus.STATUS_CANCELED
ABORTED = GoalStatus.STATUS_ABORTED


def server(name: str = "count", **changes: Any) -> Any:
    return planned_endpoint(EndpointKind.ACTION_SERVER, name, TYPE, **changes)


def client(name: str = "count", **changes: Any) -> Any:
    return planned_endpoint(EndpointKind.ACTION_CLIENT, name, TYPE, **changes)


class Counting(LifecycleNode):
    """Counts to a goal's order, one number each time that it is let go on."""

    said: list[str]
    go_on: Future | None = None

    @on_action("count")
    async def count(self, goal: Any) -> Fibonacci.Result:
        counted: list[int] = []
        for number in range(goal.request.order):
            self.go_on = Future()
            await self.go_on
            if not goal.is_active:
                self.said.append("not active")
                return Fibonacci.Result(sequence=counted)
            counted.append(number)
            goal.publish_feedback(Fibonacci.Feedback(sequence=counted))
            if goal.is_cancel_requested:
                goal.canceled()
                return Fibonacci.Result(sequence=counted)
        goal.succeed()
        return Fibonacci.Result(sequence=counted)


def step(driver: Driver, node: Counting) -> None:
    driver.spin_until(lambda: node.go_on is not None and not node.go_on.done())
    assert node.go_on is not None
    node.go_on.set_result(None)
