"""Node classes that a host imports as `hosted:Class`."""

from __future__ import annotations

import sys
import time
from typing import Any

import rclpy
from rclpy.action import ActionServer
from rclpy.lifecycle import LifecycleNode as RclpyLifecycleNode
from rclpy.node import Node
from rclpy.task import Future
from std_msgs.msg import String
from std_srvs.srv import Trigger
from test_msgs.action import Fibonacci

from lifecycle import LifecycleNode, on_message


class Good(LifecycleNode):
    """Does everything right."""


class Echo(LifecycleNode):
    """Says on `out` what it hears on `in`."""

    @on_message("in")
    def receive(self, message: String) -> None:
        self.publisher("out").publish(message)


class Raising(LifecycleNode):
    def __init__(self) -> None:
        super().__init__()
        raise OSError("no such camera")


class Stuck(LifecycleNode):
    """Awaits for ever in on_configure."""

    async def on_configure(self) -> None:
        await self.create_client(Trigger, "/nobody").call_async(Trigger.Request())


class Late(LifecycleNode):
    """Answers itself once its server is destroyed."""

    async def on_configure(self) -> None:
        self.server = self.create_service(Trigger, "late", self.answer)
        self.asked, self.gone, self.answered = Future(), Future(), Future()
        client = self.create_client(Trigger, "late")
        while not client.service_is_ready():
            await self.sleep(0.01)
        client.call_async(Trigger.Request())
        await self.asked
        self.destroy_service(self.server)
        self.gone.set_result(None)
        await self.answered

    async def answer(
        self, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        self.asked.set_result(None)
        await self.gone
        self.answered.set_result(None)
        return response


class Blocking(LifecycleNode):
    """Blocks the executor for ever in on_configure."""

    def on_configure(self) -> None:
        time.sleep(3600)


class BlockingConstructor(LifecycleNode):
    def __init__(self) -> None:
        super().__init__()
        print("constructing", file=sys.stderr, flush=True)
        time.sleep(3600)


class Plain(Node):
    def __init__(self, **options: Any) -> None:
        super().__init__("its_own_name", **options)
        self.create_publisher(String, "out", 10)
        label = self.declare_parameter("label", "none").value
        print("label", label, file=sys.stderr, flush=True)


class Acting(Node):
    """A plain node whose action raises at a goal of order 0, and succeeds at others."""

    def __init__(self) -> None:
        super().__init__("acting")
        self.server = ActionServer(self, Fibonacci, "count", self.count)

    def count(self, goal: Any) -> Fibonacci.Result:
        if not goal.request.order:
            raise OSError("no such number")
        goal.succeed()
        return Fibonacci.Result()


class Ending(Node):
    """Shuts rclpy down, as scripts do once they have what they want."""

    def __init__(self) -> None:
        super().__init__("ending")
        self.create_timer(0.01, rclpy.shutdown)


def nothing() -> None:
    """Make a node and return nothing."""
    Plain()


def two() -> list[Node]:
    """Return two nodes."""
    return [Node("first"), Node("second")]


class WithHelper(Node):
    """Makes a second node in its constructor."""

    def __init__(self, node_name: str) -> None:
        super().__init__(node_name)
        self.helper = Node("helper")
        self.helper.create_publisher(String, "out", 3)


class Theirs(RclpyLifecycleNode):
    """A managed node of rclpy's own."""

    def __init__(self) -> None:
        super().__init__("theirs")
        self.create_publisher(String, "out", 1)
