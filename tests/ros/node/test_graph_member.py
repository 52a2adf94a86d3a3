"""What a node tells the graph of itself, on the graph topic."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import rclpy
from lifecycle_driver import Driver
from planning import built_with, planned, publisher
from std_msgs.msg import String

from lifecycle import LifecycleNode, codec
from lifecycle.graph.reporter import receive
from lifecycle.graph.status import MappingStatus, NodeStatus
from lifecycle.verify.observation import NodeConfiguration
from lifecycle.verify.tool_filter import GRAPH_TOPIC


class It(LifecycleNode):
    """Publishes."""


@pytest.fixture
def statuses(driver: Driver) -> Iterator[list[NodeStatus]]:
    """What /it says of itself, one status after another."""
    said: list[NodeStatus] = []
    remove = receive(driver.node, lambda each: said.append(each) if each.node == "/it" else None)
    yield said
    remove()


def build(driver: Driver, context: rclpy.Context, *endpoints: Any, **plan: Any) -> It:
    with built_with(planned("it", *endpoints, **plan), context):
        node = It()
    driver.add(node)
    return node


def test_a_node_reports_its_states_connections_mappings_and_checksums(
    driver: Driver, context: rclpy.Context, statuses: list[NodeStatus]
) -> None:
    node = build(driver, context, publisher("out"), events=True)
    driver.spin_until(lambda: statuses and statuses[-1].state == "unconfigured")
    for label in ("configure", "connect", "activate"):
        assert driver.set("/it", label)
    driver.spin_until(lambda: statuses[-1].state == "active" and statuses[-1].mappings)
    assert ("inactive", True) in [(each.state, each.connected) for each in statuses]
    assert statuses[-1].mappings == (MappingStatus(endpoint="publishers/out", matched=0),)
    driver.spin_until(node.map_to("out", node.connect_to("udpv4://127.0.0.1", name="net")).done)
    driver.node.create_subscription(String, "/out", lambda m: None, 10)
    on_net = MappingStatus(endpoint="publishers/out", connection="net", matched=1)
    driver.spin_until(lambda: statuses[-1].mappings == (on_net,))
    (net,) = (each for each in statuses[-1].connections if each.name == "net")
    assert (net.urls, net.established) == (("udpv4://127.0.0.1",), True)
    configuration = codec.from_json(driver.configuration("/it"), NodeConfiguration)
    driver.spin_until(lambda: configuration.checksum == statuses[-1].checksum)
    node.disconnect("net")
    driver.spin_until(lambda: "net" not in {each.name for each in statuses[-1].connections})
    driver.spin_until(lambda: statuses[-1].checksum != configuration.checksum)
    driver.remove(node)
    driver.spin_until(lambda: statuses[-1].left)
    assert len({each.instance for each in statuses}) == 1


def test_who_comes_later_is_told_what_a_node_is(driver: Driver, context: rclpy.Context) -> None:
    build(driver, context, publisher("out"), events=True)
    assert driver.set("/it", "configure")
    later: list[NodeStatus] = []
    remove = receive(driver.node, later.append)
    driver.spin_until(lambda: [(each.node, each.state) for each in later] == [("/it", "inactive")])
    remove()


def test_a_node_whose_plan_says_no_events_stays_off_the_graph_topic(
    driver: Driver, context: rclpy.Context
) -> None:
    build(driver, context, publisher("out"))
    assert driver.set("/it", "configure")
    names = driver.node.get_publisher_names_and_types_by_node("it", "/")
    assert GRAPH_TOPIC not in {name for name, _ in names}


def test_a_node_that_only_comes_and_goes_reports_no_connections(
    driver: Driver, context: rclpy.Context, statuses: list[NodeStatus]
) -> None:
    node = build(driver, context, publisher("out"), membership=True)
    driver.spin_until(lambda: bool(statuses))
    for label in ("configure", "connect"):
        assert driver.set("/it", label)
    driver.remove(node)
    driver.spin_until(lambda: statuses[-1].left)
    assert "inactive" in {each.state for each in statuses}
    assert "" not in {each.checksum for each in statuses[1:]}
    assert {(*each.connections, *each.mappings) for each in statuses} == {()}
