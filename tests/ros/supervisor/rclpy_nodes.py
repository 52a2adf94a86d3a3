"""Nodes that know nothing of us, as others write them for rclpy."""

from __future__ import annotations

import time

import rclpy
from rclpy.action import ActionServer
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.event_handler import PublisherEventCallbacks, QoSPublisherMatchedInfo
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger
from test_msgs.action import Fibonacci


class Talker(Node):
    """Says words often, and its name once, in its constructor."""

    def __init__(self, word: str = "hello", period_s: float = 0.02) -> None:
        super().__init__("talker")
        self.declare_parameter("loud", False)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.name = self.create_publisher(String, "name", latched)
        events = PublisherEventCallbacks(matched=self.matched)
        self.words = self.create_publisher(String, "words", 7, event_callbacks=events)
        self.word = word
        self.create_timer(period_s, self.tick)
        self.create_service(Trigger, "reset", lambda _, response: response)
        self.say("constructed")
        self.name.publish(String(data="talker"))

    def say(self, word: str) -> None:
        loud = self.get_parameter("loud").value
        self.words.publish(String(data=word.upper() if loud else word))

    def tick(self) -> None:
        self.say(self.word)

    def matched(self, status: QoSPublisherMatchedInfo) -> None:
        self.get_logger().info(f"matched with {status.current_count}")


class Sleeper(Node):
    """Sleeps once in a timer's callback, `alone` in a group of its own."""

    def __init__(self, *, alone: bool = False) -> None:
        super().__init__("sleeper")
        group = MutuallyExclusiveCallbackGroup() if alone else None
        self.timer = self.create_timer(0.05, self.sleep, callback_group=group)

    def sleep(self) -> None:
        self.timer.cancel()
        time.sleep(2.5)
        self.get_logger().info("slept")


class Raising(Node):
    """Raises in a coroutine, a moment after it was released."""

    def __init__(self) -> None:
        super().__init__("raising")
        self.create_timer(0.2, self.raise_)

    async def raise_(self) -> None:
        raise OSError("the sensor is on fire")


class Leaving(Node):
    """Destroys itself a moment after it was released; its process goes on."""

    def __init__(self) -> None:
        super().__init__("leaving")
        self.create_timer(0.2, self.destroy_node)


class Listener(Node):
    """Prints what it hears."""

    def __init__(self) -> None:
        Node.__init__(self, "ears")
        self.create_subscription(String, "words", self.hear, 10)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.create_subscription(String, "name", self.hear, latched)

    def hear(self, message: String) -> None:
        self.get_logger().info(f"heard {message.data}")


class Managed(LifecycleNode):
    """A managed node as rclpy's demos have them."""

    def __init__(self) -> None:
        super().__init__("managed_by_rclpy")
        self.status = self.create_publisher(String, "status", 1)

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.words = self.create_lifecycle_publisher(String, "words", 7)
        self.timer = self.create_timer(0.02, self.tick)
        return super().on_configure(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.destroy_timer(self.timer)
        self.destroy_lifecycle_publisher(self.words)
        return super().on_cleanup(state)

    def tick(self) -> None:
        self.words.publish(String(data="managed"))
        self.status.publish(String(data="ticking"))


class Broken(LifecycleNode):
    """Raises where it may not."""

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        raise OSError("no such camera")


class Adder(Node):
    """A service whose callback calls another: it needs more than one thread."""

    def __init__(self) -> None:
        super().__init__("adder")
        group = rclpy.callback_groups.ReentrantCallbackGroup()
        self.inner = self.create_client(SetBool, "inner", callback_group=group)
        self.create_service(SetBool, "inner", self.answer, callback_group=group)
        self.create_service(SetBool, "outer", self.ask, callback_group=group)
        self.action = ActionServer(self, Fibonacci, "count", lambda goal: Fibonacci.Result())

    def answer(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        response.success = request.data
        return response

    def ask(self, request: SetBool.Request, _: SetBool.Response) -> SetBool.Response:
        return self.inner.call(request)


class Caller(Node):
    """Calls a service once and raises the answer."""

    def __init__(self) -> None:
        super().__init__("caller")
        self.client = self.create_client(SetBool, "outer")
        self.timer = self.create_timer(0.05, self.call)

    def call(self) -> None:
        self.timer.cancel()
        self.client.call_async(SetBool.Request(data=True)).add_done_callback(self.answered)

    def answered(self, future: rclpy.Future) -> None:
        raise RuntimeError(f"answered {future.result().success}")


def pair(word: str) -> list[Node]:
    """Return a talker and a listener."""
    return [Listener(), Talker(word)]
