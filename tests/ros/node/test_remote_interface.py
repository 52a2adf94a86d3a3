"""The node interface for others: by services of a standard type, and over the control channel."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import pytest
import rclpy
from hearing import Hearing
from host_process import HostProcess, hosted
from lifecycle_driver import Driver
from planning import built_with, planned, publisher, subscription
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from std_msgs.msg import String

from lifecycle import codec
from lifecycle.node.host.control import Operation
from lifecycle.plan.model import ParticipantConnections
from lifecycle.verify.observation import NodeConfiguration
from tests.ros.stranger import stranger

UDP = "udpv4://127.0.0.1"


@pytest.fixture
def node(driver: Driver, context: rclpy.Context) -> Hearing:
    """A node that hears and speaks, active and spun."""
    with built_with(planned("it", subscription("in"), publisher("out")), context):
        it = Hearing()
    driver.add(it)
    for label in ("configure", "connect", "activate"):
        assert driver.set("/it", label)
    return it


def text(value: str) -> ParameterValue:
    return ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=value)


def texts(*values: str) -> ParameterValue:
    kind = ParameterType.PARAMETER_STRING_ARRAY
    return ParameterValue(type=kind, string_array_value=values)


def ask(
    driver: Driver, service: str, *parameters: tuple[str, ParameterValue]
) -> list[tuple[bool, str]]:
    request = SetParameters.Request(
        parameters=[Parameter(name=name, value=value) for name, value in parameters]
    )
    answer = driver.call(SetParameters, f"/it/{service}", request)
    return [(each.successful, each.reason) for each in answer.results]


def test_a_plain_client_connects_maps_renames_and_disconnects(
    driver: Driver, node: Hearing
) -> None:
    done = [(True, "")]
    assert ask(driver, "connect_to", ("net", text(UDP)), ("mem", texts("shm://"))) == done * 2
    both = (("publishers/out", text("net")), ("in", text("net")))
    assert ask(driver, "map_to", *both) == done * 2
    assert ask(driver, "remap", ("in", text("/there"))) == done
    configuration = codec.from_json(driver.configuration("/it"), NodeConfiguration)
    in_, out = configuration.endpoints
    assert (in_.connection, in_.resolved) == ("net", "/there")
    assert out.connection == "net"
    assert [(each.name, each.urls, each.mappings) for each in configuration.connections] == [
        ("", (), ()),
        ("net", (UDP,), ("subscriptions/in", "publishers/out")),
        ("mem", ("shm://",), ()),
    ]
    sender = driver.node.create_publisher(String, "/there", 10)
    driver.spin_until(lambda: sender.get_subscription_count() == 1)
    sender.publish(String(data="hello"))
    driver.spin_until(lambda: node.heard == ["hello"])
    assert (
        ask(driver, "disconnect", ("mem", ParameterValue()), ("net", text("ignored"))) == done * 2
    )
    assert node.mappings == (("subscriptions/in", None), ("publishers/out", None))


def test_the_answer_to_map_to_comes_when_the_handover_is_over(
    driver: Driver, node: Hearing
) -> None:
    sender = driver.node.create_publisher(String, "/in", 10)
    driver.spin_until(lambda: sender.get_subscription_count() == 1)
    assert ask(driver, "connect_to", ("net", text(UDP))) == [(True, "")]
    assert ask(driver, "map_to", ("in", text("net"))) == [(True, "")]
    driver.spin_until(lambda: node.count_subscribers("/in") == 1 == sender.get_subscription_count())
    sender.publish(String(data="after"))
    driver.spin_until(lambda: node.heard == ["after"])


@pytest.mark.parametrize(
    ("service", "name", "value", "reason"),
    [
        (
            "map_to",
            "vidoe",
            text("net"),
            "cannot find endpoint 'vidoe' of /it; declared: 'subscriptions/in', 'publishers/out'",
        ),
        (
            "map_to",
            "out",
            text("net"),
            "cannot find connection 'net' of /it; connected: none but its own participant, ''",
        ),
        (
            "connect_to",
            "net",
            ParameterValue(type=ParameterType.PARAMETER_INTEGER, integer_value=7),
            (
                "cannot use the value given for 'net': it is no string, and no strings; write "
                "{type: 4, string_value: '…'} or {type: 9, string_array_value: ['…']}"
            ),
        ),
        (
            "disconnect",
            "",
            ParameterValue(),
            (
                "cannot disconnect /it from its own participant: its services are on it; map its "
                "endpoints onto another connection, or take transition 'disconnect'"
            ),
        ),
    ],
)
def test_a_refused_request_says_why_and_the_node_lives(
    driver: Driver,
    node: Hearing,
    service: str,
    name: str,
    value: ParameterValue,
    reason: str,
) -> None:
    assert ask(driver, service, (name, value)) == [(False, reason)]
    assert driver.state("/it") == (3, "active")
    assert node.mappings == (("subscriptions/in", ""), ("publishers/out", ""))


def test_one_wrong_request_of_several_does_not_spoil_the_others(
    driver: Driver, node: Hearing
) -> None:
    answers = ask(driver, "connect_to", ("no name", text(UDP)), ("net", text(UDP)))
    assert [ok for ok, _ in answers] == [False, True]
    assert [each.name for each in node.connections] == ["", "net"]


# The control channel.

Start = Callable[..., HostProcess]


def mappings(configuration: NodeConfiguration | None) -> Sequence[tuple[str, str, bool]]:
    assert configuration is not None
    return [(each.name, each.connection, each.mapped) for each in configuration.endpoints]


def test_a_supervisor_does_the_same_over_the_control_channel(start: Start) -> None:
    host = start(hosted("it", "Echo", subscription("in"), publisher("out")))
    host.until("ready")
    assert host.do("/it", Operation.CONFIGURE).ok
    how = ParticipantConnections(urls=(UDP,))
    assert host.do("/it", Operation.CONNECT_TO, connection="net", connections=how).ok
    mapped = host.do("/it", Operation.MAP_TO, endpoint="publishers/out", connection="net")
    assert mapped.ok, mapped.error
    assert mappings(mapped.configuration) == [("in", "", False), ("out", "net", True)]
    connected = host.do("/it", Operation.CONNECT)
    assert mappings(connected.configuration) == [("in", "", True), ("out", "net", True)]
    refused = host.do("/it", Operation.MAP_TO, endpoint="map", connection="net")
    assert (refused.ok, refused.configuration) == (False, None)
    assert refused.error == (
        "cannot find endpoint 'map' of /it; declared: 'subscriptions/in', 'publishers/out'"
    )
    gone = host.do("/it", Operation.DISCONNECT_FROM, connection="net")
    assert mappings(gone.configuration) == [("in", "", True), ("out", "", False)]
    assert host.do("/it", Operation.ACTIVATE).configuration is None
    host.hang_up()
    assert host.wait() == 0


def test_a_supervisor_is_told_of_each_change_of_the_configuration(
    start: Start, fresh_domain: int
) -> None:
    host = start(hosted("it", "Echo", subscription("in"), publisher("out")))
    host.until("ready")
    for operation in (Operation.CONFIGURE, Operation.CONNECT, Operation.ACTIVATE):
        assert host.do("/it", operation).ok
    with stranger(fresh_domain, "peer") as peer:
        sender = peer.create_publisher(String, "/in", 10)
        told = until(host, lambda c: c.endpoints[0].matched == 1)
        checksum = told.checksum
        peer.destroy_publisher(sender)
        assert until(host, lambda c: c.endpoints[0].matched == 0).checksum == checksum
        how = ParticipantConnections(urls=(UDP,))
        host.ask("/it", Operation.CONNECT_TO, connection="net", connections=how)
        assert until(host, lambda c: len(c.connections) == 2).checksum != checksum
    host.hang_up()
    assert host.wait() == 0


def until(host: HostProcess, holds: Callable[[NodeConfiguration], Any]) -> NodeConfiguration:
    """Read until a configuration that is reported unasked is as it must be."""
    while True:
        event = host.read()
        if event.kind != "configuration":
            continue
        assert event.configuration is not None
        assert (event.node, event.state) == ("/it", event.configuration.state)
        if holds(event.configuration):
            return event.configuration
