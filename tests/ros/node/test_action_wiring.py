"""Action clients in callbacks, actions by their names in the graph, and actions on connections."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
from asking import Asking, knows_a_client
from counting import ABORTED, SUCCEEDED, TYPE, Counting, client, server, step
from lifecycle_driver import Driver
from planning import publisher, subscription
from rclpy.action import ActionServer
from rclpy.action.graph import (
    get_action_client_names_and_types_by_node,
    get_action_server_names_and_types_by_node,
)
from rclpy.task import Future
from std_msgs.msg import String
from test_msgs.action import Fibonacci

from lifecycle import LifecycleNode, on_message

Active = Callable[..., Any]
Ask = Callable[..., Asking]

UDP = "udpv4://127.0.0.1"


class Silent(LifecycleNode):
    """Does nothing by itself."""


class Caller(LifecycleNode):
    """Has others count, from an async callback."""

    got: list[Any]

    @on_message("in")
    async def count(self, message: String) -> None:
        action = self.action_client("count")
        goal = await action.send_goal_async(
            Fibonacci.Goal(order=int(message.data)), feedback_callback=self._feedback
        )
        if not goal.accepted:
            self.got.append("rejected")
            return
        answer = await goal.get_result_async()
        self.got.append((answer.status, list(answer.result.sequence)))

    def _feedback(self, message: Any) -> None:
        self.got.append(list(message.feedback.sequence))


@pytest.fixture
def call(driver: Driver) -> Callable[..., None]:
    """Have a caller send a goal to the server of that node."""
    sender = driver.node.create_publisher(String, "/in", 10)

    def call(node: Caller, order: int) -> None:
        driver.spin_until(node.action_client("count").server_is_ready)
        driver.spin_until(lambda: sender.get_subscription_count() == 1)
        sender.publish(String(data=str(order)))

    return call


@pytest.fixture
def plain_server(driver: Driver) -> Iterator[list[Any]]:
    """An ordinary rclpy action server; the goals it has."""
    goals: list[Any] = []

    async def count(goal: Any) -> Fibonacci.Result:
        goals.append(goal)
        if goal.request.order > 8:
            goal.go_on = Future()
            await goal.go_on
        goal.publish_feedback(Fibonacci.Feedback(sequence=[8]))
        goal.succeed()
        return Fibonacci.Result(sequence=[8, 8])

    server = ActionServer(driver.node, Fibonacci, "/count", count)
    yield goals
    server.destroy()


def test_a_declared_client_has_a_foreign_server_work_for_an_async_callback(
    driver: Driver, active: Active, call: Callable[..., None], plain_server: list[Any]
) -> None:
    node = active(Caller, client(), subscription("in"))
    node.got = []
    call(node, 3)
    driver.spin_until(lambda: (SUCCEEDED, [8, 8]) in node.got)
    assert [each for each in node.got if each != [8]] == [(SUCCEEDED, [8, 8])]


def test_ros2_action_sees_ours_as_it_sees_others(driver: Driver, active: Active) -> None:
    active(Counting, server(), publisher("stop"), client("other"), to="connect")

    driver.spin_until(lambda: "it" in driver.node.get_node_names())

    def servers() -> Any:
        return get_action_server_names_and_types_by_node(driver.node, "it", "/")

    def clients() -> Any:
        return get_action_client_names_and_types_by_node(driver.node, "it", "/")

    driver.spin_until(lambda: servers() == [("/count", [TYPE])])
    driver.spin_until(lambda: clients() == [("/other", [TYPE])])
    assert driver.set("/it", "disconnect")
    driver.spin_until(lambda: servers() == [] == clients())


def test_remapping_some_hidden_names_is_refused_at_connect(driver: Driver, active: Active) -> None:
    remap = (("count/_action/send_goal", "tally/_action/send_goal"),)
    node = active(Counting, server(), publisher("stop"), remap=remap, to="configure")
    error = driver.run(node.lifecycle.change, "connect").error
    assert error.startswith(
        "cannot connect action server 'count' of /it: cannot remap only some of action 'count'"
    )
    assert driver.state("/it") == (2, "inactive")


def test_an_action_on_a_connection_works_from_the_hidden_node_and_moves_back(
    driver: Driver, active: Active, ask: Ask
) -> None:
    node = active(Counting, server(), publisher("stop"))
    node.said = []
    net = node.connect_to(UDP, name="net")
    driver.spin_until(node.map_to("action_servers/count", net).done)
    asking = ask("/count", net.participant.node)
    driver.spin_until(lambda: "_it_net" in driver.node.get_node_names())
    driver.spin_until(
        lambda: (
            get_action_server_names_and_types_by_node(driver.node, "_it_net", "/")
            == [("/count", [TYPE])]
        )
    )
    goal = asking.goal(order=1)
    step(driver, node)
    assert asking.result(goal) == (SUCCEEDED, [0])

    goal = asking.goal(order=9)
    result = goal.get_result_async()
    step(driver, node)
    driver.spin_until(lambda: asking.feedback[-1:] == [[0]])
    driver.settle()
    driver.spin_until(node.map_to("action_servers/count", "").done)
    driver.spin_until(result.done)
    assert result.result().status == ABORTED
    step(driver, node)
    driver.spin_until(lambda: node.said == ["not active"])
    node.disconnect("net")
    driver.spin_until(lambda: "_it_net" not in driver.node.get_node_names())
    again = ask("/count", node)
    goal = again.goal()
    step(driver, node)
    assert again.result(goal) == (SUCCEEDED, [0])


def test_a_client_on_a_connection_has_its_answers(
    driver: Driver, active: Active, call: Callable[..., None], plain_server: list[Any]
) -> None:
    node = active(Caller, client(), subscription("in"), to="configure")
    node.got = []
    net = node.connect_to(UDP, name="net")
    node.map_to("action_clients/count", net)
    assert driver.set("/it", "activate")
    driver.spin_until(lambda: knows_a_client(driver.node, "/count"))
    call(node, 3)
    driver.spin_until(lambda: (SUCCEEDED, [8, 8]) in node.got)
    assert node.mappings == (("action_clients/count", "net"), ("subscriptions/in", ""))


def test_a_client_that_is_handed_over_keeps_its_old_place_for_answers(
    driver: Driver, active: Active, call: Callable[..., None], plain_server: list[Any]
) -> None:
    node = active(Caller, client(), subscription("in"))
    node.got = []
    before = node.action_client("count")
    call(node, 9)
    driver.spin_until(lambda: plain_server)
    net = node.connect_to(UDP, name="net")
    handed_over = node.map_to("action_clients/count", net)
    assert node.action_client("count") is not before
    assert not handed_over.done()
    plain_server[0].go_on.set_result(None)
    driver.spin_until(lambda: (SUCCEEDED, [8, 8]) in node.got)


def test_an_action_is_renamed_while_it_is_active(driver: Driver, active: Active, ask: Ask) -> None:
    node = active(Counting, server(), publisher("stop"))
    node.remap("action_servers/count", "/tally")
    asking = ask("/tally", node)
    goal = asking.goal()
    step(driver, node)
    assert asking.result(goal) == (SUCCEEDED, [0])
