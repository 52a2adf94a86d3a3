"""What a node tells the graph of itself, on the graph topic."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import rclpy
from lifecycle_driver import Driver
from planning import built_with, planned, publisher
from std_msgs.msg import String

from lifecycle import LifecycleNode, codec
from lifecycle.graph.messages import GraphMessage, Heartbeat, decode
from lifecycle.graph.transport import GRAPH_QOS
from lifecycle.verify.observation import NodeConfiguration
from lifecycle.verify.tool_filter import GRAPH_TOPIC

Told = Callable[[], list[GraphMessage]]


class It(LifecycleNode):
    """Publishes."""


@pytest.fixture
def messages(driver: Driver) -> list[GraphMessage]:
    """What /it tells, heartbeats left out."""
    told: list[GraphMessage] = []

    def arrived(message: String) -> None:
        decoded = decode(message.data)
        if decoded.node == "/it" and not isinstance(decoded, Heartbeat):
            told.append(decoded)

    driver.node.create_subscription(String, GRAPH_TOPIC, arrived, GRAPH_QOS)
    return told


def build(driver: Driver, context: rclpy.Context, *endpoints: Any, **plan: Any) -> It:
    with built_with(planned("it", *endpoints, **plan), context):
        node = It()
    driver.add(node)
    return node


def test_a_node_tells_its_states_connections_mappings_and_checksums(
    driver: Driver, context: rclpy.Context, messages: list[GraphMessage]
) -> None:
    node = build(driver, context, publisher("out"), events=True)
    driver.spin_until(lambda: driver.node.count_publishers(GRAPH_TOPIC) == 1)
    driver.settle()
    for label in ("configure", "connect", "activate"):
        assert driver.set("/it", label)
    driver.spin_until(node.map_to("out", node.connect_to("udpv4://127.0.0.1", name="net")).done)
    driver.node.create_subscription(String, "/out", lambda m: None, 10)
    driver.spin_until(lambda: sum(m.kind.value == "connection_established" for m in messages) == 2)
    configuration = codec.from_json(driver.configuration("/it"), NodeConfiguration)
    driver.spin_until(
        lambda: configuration.checksum in {getattr(each, "checksum", "") for each in messages}
    )
    node.disconnect("net")
    driver.spin_until(lambda: messages[-1].kind.value == "configuration_changed")
    driver.remove(node)
    driver.spin_until(lambda: messages[-1].kind.value == "left")

    def told(kind: str, *fields: str) -> list[tuple[Any, ...]]:
        found = [each for each in messages if each.kind.value == kind]
        return [tuple(getattr(each, field) for field in fields) for each in found]

    states = told("state_changed", "state", "connected")
    assert states[-1] == ("active", True)
    assert ("inactive", True) in states
    net = ("net", ("udpv4://127.0.0.1",))
    assert told("connection_established", "connection", "urls") == [net, net]
    assert told("connection_lost", "connection", "urls", "error") == [(*net, "")]
    out = "publishers/out"
    assert told("mapping_established", "endpoint", "connection", "matched") == [
        (out, "", 0),
        (out, "net", 0),
        (out, "net", 1),
    ]
    assert told("mapping_lost", "endpoint", "connection") == [(out, ""), (out, "net")]
    assert configuration.checksum in {each for (each,) in told("configuration_changed", "checksum")}
    assert [each.sequence for each in messages] == sorted(each.sequence for each in messages)


def test_a_node_whose_plan_says_no_events_stays_off_the_graph_topic(
    driver: Driver, context: rclpy.Context
) -> None:
    build(driver, context, publisher("out"))
    assert driver.set("/it", "configure")
    names = driver.node.get_publisher_names_and_types_by_node("it", "/")
    assert GRAPH_TOPIC not in {name for name, _ in names}


def test_a_node_that_only_comes_and_goes_tells_no_connections(
    driver: Driver, context: rclpy.Context, messages: list[GraphMessage]
) -> None:
    node = build(driver, context, publisher("out"), membership=True)
    driver.spin_until(lambda: driver.node.count_publishers(GRAPH_TOPIC) == 1)
    driver.settle()
    for label in ("configure", "connect"):
        assert driver.set("/it", label)
    driver.remove(node)
    driver.spin_until(lambda: bool(messages) and messages[-1].kind.value == "left")
    kinds = {each.kind.value for each in messages}
    assert "state_changed" in kinds
    assert kinds & {"connection_established", "mapping_established", "mapping_lost"} == set()
