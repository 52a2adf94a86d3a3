"""The executor of our processes calls back as rclpy's does, and wakes for nothing else."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.task import Future
from std_msgs.msg import String
from std_srvs.srv import Trigger

from lifecycle.middleware import NodeExecutor

MakeNode = Callable[..., Node]
BOUND_S = 5.0


class Spinning:
    """An executor that a timer of its own keeps awake.

    Attributes:
        turns: callbacks called, those of that timer included.
    """

    def __init__(self, node: Node) -> None:
        self.turns = 0
        self.executor = NodeExecutor(context=node.context)
        self.executor.add_node(node)
        node.create_timer(0.02, lambda: None, callback_group=ReentrantCallbackGroup())

    def until(self, condition: Callable[[], bool]) -> None:
        deadline = time.monotonic() + BOUND_S
        while not condition():
            assert time.monotonic() < deadline
            self.executor.next_callback()()
            self.turns += 1


@pytest.fixture
def node(make_node: MakeNode) -> Node:
    return make_node("spun")


@pytest.fixture
def spinning(node: Node) -> Spinning:
    return Spinning(node)


def test_a_callback_awaits_what_the_same_executor_brings(node: Node, spinning: Spinning) -> None:
    group = ReentrantCallbackGroup()

    async def answer(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.message = "yes"
        return response

    node.create_service(Trigger, "ask", answer, callback_group=group)
    client = node.create_client(Trigger, "ask", callback_group=group)
    answers: list[str] = []

    async def ask(message: String) -> None:
        response = await client.call_async(Trigger.Request())
        answers.append(f"{message.data} {response.message}")

    node.create_subscription(String, "said", ask, 10)
    publisher = node.create_publisher(String, "said", 10)
    spinning.until(lambda: publisher.get_subscription_count() > 0 and client.service_is_ready())
    publisher.publish(String(data="really?"))
    spinning.until(lambda: bool(answers))
    assert answers == ["really? yes"]


def test_what_a_suspended_callback_excludes_waits_without_a_busy_loop(
    node: Node, spinning: Spinning
) -> None:
    ended, called = Future(), []

    async def hold(_: String) -> None:
        called.append("held")
        await ended
        called.append("released")

    node.create_subscription(String, "hold", hold, 10)
    node.create_subscription(String, "also", lambda _: called.append("also"), 10)
    publishers = [node.create_publisher(String, each, 10) for each in ("hold", "also")]
    spinning.until(lambda: all(each.get_subscription_count() for each in publishers))
    publishers[0].publish(String())
    spinning.until(lambda: bool(called))
    publishers[1].publish(String())
    spinning.turns, began_s = 0, time.monotonic()
    spinning.until(lambda: time.monotonic() > began_s + 0.3)
    assert called == ["held"]
    assert spinning.turns < 150  # three a tick of the timer: itself, and the suspended one twice
    ended.set_result(None)
    spinning.until(lambda: len(called) == 3)
    assert called == ["held", "released", "also"]


def test_what_a_callback_destroys_is_not_called_after_it(node: Node, spinning: Spinning) -> None:
    called: list[str] = []
    subscriptions = []

    def take(message: String) -> None:
        called.append(message.data)
        for each in subscriptions:
            node.destroy_subscription(each)

    subscriptions += [node.create_subscription(String, "said", take, 10) for _ in range(2)]
    publisher = node.create_publisher(String, "said", 10)
    spinning.until(lambda: publisher.get_subscription_count() == 2)
    publisher.publish(String(data="once"))
    spinning.until(lambda: bool(called))
    spinning.until(lambda: publisher.get_subscription_count() == 0)
    assert called == ["once"]


def test_what_a_callback_raises_is_raised_and_the_next_one_is_called(
    node: Node, spinning: Spinning
) -> None:
    called: list[str] = []

    def take(message: String) -> None:
        called.append(message.data)
        raise ValueError(message.data)

    node.create_subscription(String, "said", take, 10)
    publisher = node.create_publisher(String, "said", 10)
    spinning.until(lambda: publisher.get_subscription_count() > 0)
    for data in ("one", "two"):
        publisher.publish(String(data=data))
        with pytest.raises(ValueError, match=data):
            spinning.until(lambda: False)
