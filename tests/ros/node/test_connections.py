"""Connections on real DDS: made, mapped onto, handed over, lost and unmade while the node runs."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import rclpy
from hearing import Hearing
from lifecycle_driver import Driver
from msgspec.structs import replace
from planning import built_with, client, planned, publisher, server, subscription
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String
from std_srvs.srv import Trigger

from lifecycle import LifecycleNode, codec, on_service
from lifecycle.graph.state import EventKind, GraphEvent
from lifecycle.manifest.model import Authority
from lifecycle.manifest.qos import Durability
from lifecycle.network.nfe import TransportProtocol, UniqueRequirement
from lifecycle.node import data_layer
from lifecycle.node.connections import ConnectError, UnknownConnectionError
from lifecycle.node.data_layer import NotConfiguredError
from lifecycle.node.endpoint import UnknownEndpointError
from lifecycle.plan.model import ParticipantConnections, PlannedParticipant
from lifecycle.verify.observation import NodeConfiguration

Active = Callable[..., Any]
STRICT = UniqueRequirement.STRICTLY_REQUIRED
UDP = "udpv4://127.0.0.1"
OTHER_UDP = "udpv4://127.0.0.1?ttl=2"
RELIABLE = QoSProfile(depth=1000)
"""More than is sent while a busy machine keeps a receiving thread waiting."""


class Talking(LifecycleNode):
    """Publishes."""


class Everything(Hearing):
    @on_service("reset")
    def reset(self, request: Trigger.Request, response: Trigger.Response) -> None:
        response.success = True
        response.message = "was reset"


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A client that is handed over has no peers that could end its patience."""
    monkeypatch.setattr(data_layer, "PATIENCE_S", 0.1)


def configuration(driver: Driver) -> NodeConfiguration:
    return codec.from_json(driver.configuration("/it"), NodeConfiguration)


def reliable(endpoint: Callable[..., Any], name: str, **changes: Any) -> Any:
    made = endpoint(name, **changes)
    return replace(made, qos=replace(made.qos, depth=1000))


def numbers(first: int, count: int) -> list[str]:
    return [str(each) for each in range(first, first + count)]


@pytest.mark.usefixtures("impatient")
def test_one_connection_carries_many_mappings_of_every_kind(driver: Driver, active: Active) -> None:
    node = active(
        Everything, subscription("in"), publisher("out"), server("reset"), client("reset")
    )
    net = node.connect_to(UDP, name="net")
    mapped = (
        "subscriptions/in",
        "publishers/out",
        "service_servers/reset",
        "service_clients/reset",
    )
    for each in mapped:
        done = node.map_to(each, net)
        driver.spin_until(done.done)
    assert node.mappings == tuple((each, "net") for each in mapped)
    own, connection = node.connections
    assert (own.name, own.mappings) == ("", ())
    assert (connection.name, connection.urls, connection.node_name) == ("net", (UDP,), "_it_net")
    assert connection.mappings == mapped

    got: list[str] = []
    driver.node.create_subscription(String, "/out", lambda m: got.append(m.data), 10)
    sender = driver.node.create_publisher(String, "/in", 10)
    driver.spin_until(lambda: sender.get_subscription_count() == 1)
    driver.spin_until(lambda: node.publisher("out").get_subscription_count() == 1)
    sender.publish(String(data="there"))
    node.publisher("out").publish(String(data="here"))
    driver.spin_until(lambda: (node.heard, got) == (["there"], ["here"]))
    answer = driver.call(Trigger, "/reset", Trigger.Request())
    assert (answer.success, answer.message) == (True, "was reset")
    driver.spin_until(node.client("reset").service_is_ready)
    future = node.client("reset").call_async(Trigger.Request())
    driver.spin_until(future.done)
    assert future.result().message == "was reset"

    reports = configuration(driver).endpoints
    assert {(each.connection, each.participant, each.mapped) for each in reports} == {
        ("net", "_it_net", True)
    }
    in_, out = reports[0], reports[1]
    assert in_.gid[:24] == out.gid[:24] != ""
    assert out.nfes is not None
    assert all(nfe.transport_protocol is TransportProtocol.UDP for nfe in out.nfes)


def test_a_subscription_is_handed_over_under_traffic_and_nothing_is_lost(
    driver: Driver, active: Active
) -> None:
    node = active(Hearing, reliable(subscription, "in"))
    sender = driver.node.create_publisher(String, "/in", RELIABLE)
    driver.spin_until(lambda: sender.get_subscription_count() == 1)
    sent = [0]

    def send() -> None:
        sender.publish(String(data=str(sent[0])))
        sent[0] += 1

    timer = driver.node.create_timer(0.002, send)
    driver.spin_until(lambda: len(node.heard) > 20)
    for url, name in ((UDP, "net"), (OTHER_UDP, "other"), (None, "")):
        if url is not None:
            node.connect_to(url, name=name)
        before = node.mappings[0][1]
        done = node.map_to("in", name)
        driver.spin_until(done.done)
        assert node.mappings == (("subscriptions/in", name),)
        if before:
            node.disconnect(before)
        heard = len(node.heard)
        driver.spin_until(lambda heard=heard: len(node.heard) > heard + 20)
    driver.node.destroy_timer(timer)
    driver.spin_until(lambda: len(set(node.heard)) == sent[0])  # some come both ways
    assert [each.name for each in node.connections] == [""]
    driver.spin_until(lambda: sender.get_subscription_count() == 1)


def test_a_publisher_is_handed_over_under_traffic_and_its_handle_stays(
    driver: Driver, active: Active
) -> None:
    node = active(Talking, reliable(publisher, "out"))
    heard: list[str] = []
    driver.node.create_subscription(String, "/out", lambda m: heard.append(m.data), RELIABLE)
    out = node.publisher("out")
    driver.spin_until(lambda: out.get_subscription_count() == 1)
    sent = [0]

    def send() -> None:
        out.publish(String(data=str(sent[0])))
        sent[0] += 1

    timer = driver.node.create_timer(0.002, send)
    driver.spin_until(lambda: len(heard) > 20)
    driver.spin_until(node.map_to("out", node.connect_to(UDP, name="net")).done)
    count = len(heard)
    driver.spin_until(lambda: len(heard) > count + 20)
    driver.node.destroy_timer(timer)
    driver.spin_until(lambda: len(heard) == sent[0])
    assert heard == numbers(0, sent[0])
    assert node.publisher("out") is out
    driver.spin_until(lambda: driver.node.count_publishers("/out") == 1)


def latched(name: str, depth: int = 2) -> Any:
    made = publisher(name)
    qos = replace(made.qos, durability=Durability.TRANSIENT_LOCAL, depth=depth)
    return replace(made, qos=qos)


def latecomer(driver: Driver, topic: str) -> list[str]:
    """What somebody is told who subscribes only now, and wants to know what was said before."""
    told: list[str] = []
    qos = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    driver.node.create_subscription(String, topic, lambda m: told.append(m.data), qos)
    return told


def test_what_a_transient_local_publisher_has_said_goes_along_with_it(
    driver: Driver, active: Active
) -> None:
    node = active(Talking, latched("map"))
    for each in ("one", "two", "three"):
        node.publisher("map").publish(String(data=each))
    net = node.connect_to(UDP, name="net")
    driver.spin_until(node.map_to("map", net).done)
    told = latecomer(driver, "/map")
    driver.spin_until(lambda: told == ["two", "three"])
    # Also where there was none for a while, and under another name.
    node.disconnect("net")
    node.map_to("map", "")
    told = latecomer(driver, "/map")
    driver.spin_until(lambda: told == ["two", "three"])
    node.remap("map", "/plan")
    told = latecomer(driver, "/plan")
    driver.spin_until(lambda: told == ["two", "three"])


def test_what_a_transient_local_publisher_has_said_waits_for_an_inactive_node(
    driver: Driver, active: Active
) -> None:
    node = active(Talking, latched("map"))
    node.publisher("map").publish(String(data="old"))
    assert driver.set("/it", "deactivate")
    driver.spin_until(node.map_to("map", node.connect_to(UDP, name="net")).done)
    told = latecomer(driver, "/map")
    driver.spin_until(lambda: node.publisher("map").get_subscription_count() == 1)
    driver.settle()
    assert told == []
    assert driver.set("/it", "activate")
    driver.spin_until(lambda: told == ["old"])


def test_a_disconnect_forgets_what_a_transient_local_publisher_has_said(
    driver: Driver, active: Active
) -> None:
    node = active(Talking, latched("map"))
    node.publisher("map").publish(String(data="old"))
    for label in ("deactivate", "disconnect", "connect", "activate"):
        assert driver.set("/it", label)
    told = latecomer(driver, "/map")
    driver.spin_until(lambda: node.publisher("map").get_subscription_count() == 1)
    node.publisher("map").publish(String(data="new"))
    driver.spin_until(lambda: bool(told))
    assert told == ["new"]


def test_the_gate_holds_through_a_handover(driver: Driver, active: Active) -> None:
    node = active(Hearing, subscription("in"), publisher("out"), to="connect")
    got: list[str] = []
    driver.node.create_subscription(String, "/out", lambda m: got.append(m.data), 10)
    sender = driver.node.create_publisher(String, "/in", 10)
    net = node.connect_to(UDP, name="net")
    for name in ("in", "out"):
        driver.spin_until(node.map_to(name, net).done)
    driver.spin_until(lambda: sender.get_subscription_count() == 1)
    driver.spin_until(lambda: node.publisher("out").get_subscription_count() == 1)
    sender.publish(String(data="early"))
    node.publisher("out").publish(String(data="early"))
    driver.settle()
    assert driver.set("/it", "activate")
    sender.publish(String(data="now"))
    node.publisher("out").publish(String(data="now"))
    driver.spin_until(lambda: node.heard and got)
    assert (node.heard, got) == (["now"], ["now"])


def test_where_the_new_connection_fails_the_old_mapping_stays(
    driver: Driver, active: Active
) -> None:
    node = active(Talking, publisher("map"), publisher("video", unique=STRICT), to="configure")
    net = node.connect_to(UDP, name="net")
    own = node.connect_to(OTHER_UDP, name="own")
    node.map_to("map", net)
    node.map_to("video", own)
    with pytest.raises(ConnectError) as error:
        node.map_to("video", net)
    assert str(error.value) == (
        "cannot map publisher 'video' of /it to 'net': publisher 'video' must have a network flow "
        "for itself (strictly_required), and would share one; give it a connection of its own"
    )
    for name, target in (("map", own), ("video", "")):
        with pytest.raises(ConnectError, match="'video' must have a network flow for itself"):
            node.map_to(name, target)
    assert node.mappings == (("publishers/map", "net"), ("publishers/video", "own"))
    assert driver.set("/it", "connect")
    assert [each.error for each in configuration(driver).endpoints] == ["", ""]


def test_a_strictly_unique_subscription_has_a_port_of_its_own_on_a_connection(
    driver: Driver, active: Active
) -> None:
    node = active(Hearing, subscription("in", unique=STRICT))
    driver.spin_until(node.map_to("in", node.connect_to(UDP, name="net")).done)
    (report,) = configuration(driver).endpoints
    assert report.nfes
    assert {nfe.transport_port for nfe in report.nfes} <= set(range(7000, 7400))


@pytest.mark.usefixtures("impatient")
def test_what_is_disconnected_is_mapped_nowhere_and_can_be_mapped_again(
    driver: Driver, active: Active
) -> None:
    node = active(Talking, publisher("out"), client("reset"))
    net = node.connect_to(UDP, name="net")
    assert node.connect_to(UDP, name="net") is net
    for name in ("out", "reset"):
        driver.spin_until(node.map_to(name, net).done)
    node.disconnect("net")
    assert node.mappings == (("publishers/out", None), ("service_clients/reset", None))
    assert [each.name for each in node.connections] == [""]
    assert [each.mapped for each in configuration(driver).endpoints] == [False, False]
    node.publisher("out").publish(String(data="nobody"))  # dropped, with a warning
    with pytest.raises(UnknownConnectionError) as error:
        node.map_to("out", net)
    assert str(error.value) == (
        "cannot find connection 'net' of /it; connected: none but its own participant, ''"
    )
    node.map_to("out", "")
    got: list[str] = []
    driver.node.create_subscription(String, "/out", lambda m: got.append(m.data), 10)
    driver.spin_until(lambda: node.publisher("out").get_subscription_count() == 1)
    node.publisher("out").publish(String(data="again"))
    driver.spin_until(lambda: got == ["again"])
    driver.spin_until(lambda: "_it_net" not in driver.node.get_node_names())


def test_events_tell_of_connections_and_mappings_with_their_peers(
    driver: Driver, active: Active
) -> None:
    node = active(Talking, publisher("out"), to="configure")
    events: list[GraphEvent] = []
    later: list[EventKind] = []

    async def listen(event: GraphEvent) -> None:
        later.append(event.kind)

    remove = node.on_connection_event(events.append)
    node.on_connection_event(listen)
    node.connect_to(UDP, name="net")
    node.map_to("out", "net")
    listener = driver.node.create_subscription(String, "/out", lambda m: None, 10)
    driver.spin_until(lambda: len(events) == 3)
    driver.node.destroy_subscription(listener)
    driver.spin_until(lambda: len(events) == 5)
    node.disconnect("net")
    driver.spin_until(lambda: len(events) == 6)
    made, lost = EventKind.CONNECTION_ESTABLISHED, EventKind.CONNECTION_LOST
    mapped, unmapped = EventKind.MAPPING_ESTABLISHED, EventKind.MAPPING_LOST
    kinds = [each.kind for each in events]
    assert kinds == [mapped, made, mapped, lost, unmapped, unmapped]
    assert [each.mapping.matched for each in events if each.mapping] == [0, 1, 0, 0]
    assert [each.connection.urls for each in events if each.connection] == [(UDP,)] * 2
    driver.spin_until(lambda: set(later) == set(kinds))
    remove()
    node.connect_to(UDP, name="net")
    driver.spin_until(lambda: len(later) == 7)
    assert len(events) == 6


def test_what_is_asked_wrongly_is_refused_with_what_is_allowed(
    driver: Driver, context: rclpy.Context
) -> None:
    with built_with(planned("it", publisher("video"), publisher("map")), context):
        node = Talking()
    driver.add(node)
    with pytest.raises(NotConfiguredError) as early:
        node.connect_to(UDP, name="net")
    assert str(early.value) == (
        f"cannot connect /it to {UDP}: it is 'unconfigured'; "
        "endpoints are declared from configure until cleanup; configure it first"
    )
    assert driver.set("/it", "configure")
    with pytest.raises(ConnectError) as none:
        node.connect_to(name="net")
    assert str(none.value) == (
        "cannot connect /it to 'net': no URL was given; udpv4://, tcpv4://…:5100, shm://"
    )
    with pytest.raises(ConnectError) as name:
        node.connect_to(UDP, name="my net")
    assert str(name.value) == (
        "cannot connect /it to 'my net': a connection's name is made of letters, digits and "
        "underscores, and begins with a letter"
    )
    with pytest.raises(ConnectError) as url:
        node.connect_to("upd://127.0.0.1", name="net")
    assert str(url.value) == (
        "cannot connect /it to 'net' (upd://127.0.0.1): cannot read connection URL "
        "'upd://127.0.0.1': unknown transport 'upd'; allowed: shm, udpv4, udpv6, udpm, tcpv4; "
        "write TRANSPORT://[ADDRESS][:PORT][?OPTION=VALUE&…], udpv4://10.77.0.1:7911"
    )
    own, failed = node.connections
    assert own.error == ""
    assert (failed.name, failed.established) == ("net", False)
    assert failed.error.startswith("cannot connect /it to 'net' (upd://127.0.0.1): ")
    node.disconnect("net")  # what could not be made can be forgotten
    assert [each.name for each in node.connections] == [""]
    made = node.connect_to(UDP)
    assert made.name == "connection_1"
    with pytest.raises(ConnectError) as other:
        node.connect_to(OTHER_UDP, name="connection_1")
    assert str(other.value) == (
        f"cannot connect /it to 'connection_1' ({OTHER_UDP}): it is connected to {UDP}; "
        "disconnect it first, or choose another name"
    )
    with pytest.raises(UnknownEndpointError) as unknown:
        node.map_to("vidoe", made)
    assert str(unknown.value) == (
        "cannot find endpoint 'vidoe' of /it; declared: 'publishers/video', 'publishers/map'"
    )
    with pytest.raises(UnknownConnectionError) as nowhere:
        node.map_to("video", "connection_2")
    assert str(nowhere.value) == (
        "cannot find connection 'connection_2' of /it; did you mean 'connection_1'? "
        "connected: 'connection_1'"
    )
    with pytest.raises(ConnectError) as self_:
        node.disconnect("")
    assert str(self_.value) == (
        "cannot disconnect /it from its own participant: its services are on it; map its endpoints "
        "onto another connection, or take transition 'disconnect'"
    )


def test_under_an_authority_connect_fails_until_everything_was_mapped(
    driver: Driver, active: Active
) -> None:
    node = active(
        Hearing,
        publisher("out"),
        publisher("map"),
        subscription("in"),
        to="configure",
        authority=Authority.SUPERVISOR,
    )
    node.connect_to(UDP, name="net")
    node.map_to("map", "net")
    result = driver.run(node.lifecycle.change, "connect")
    assert result.error == (
        "cannot connect /it: nobody has mapped 'publishers/out', 'subscriptions/in'; its authority "
        "is the supervisor, which connected it to 'net'; call /it/map_to for each, or write "
        "data_layer.authority: nodes"
    )
    assert driver.state("/it") == (2, "inactive")
    assert node.mappings == (
        ("publishers/out", None),
        ("publishers/map", "net"),
        ("subscriptions/in", None),
    )
    node.map_to("in", "net")
    node.map_to("out", "")
    assert driver.set("/it", "connect")
    assert driver.set("/it", "activate")
    assert driver.set("/it", "deactivate")
    assert driver.set("/it", "disconnect")
    assert [each.name for each in node.connections] == [""]
    assert {each for _, each in node.mappings} == {None}


def test_what_was_mapped_before_connect_stays_and_goes_with_cleanup(
    driver: Driver, active: Active
) -> None:
    node = active(Hearing, publisher("out"), subscription("in"), to="configure")
    node.map_to("in", node.connect_to(UDP, name="net"))
    assert driver.set("/it", "connect")
    assert node.mappings == (("publishers/out", ""), ("subscriptions/in", "net"))
    assert driver.set("/it", "disconnect")
    node.map_to("in", node.connect_to(UDP, name="net"))
    assert driver.set("/it", "cleanup")
    assert node.mappings == ()
    driver.spin_until(lambda: "_it_net" not in driver.node.get_node_names())


def planned_connection(name: str, *urls: str) -> PlannedParticipant:
    return PlannedParticipant(
        name=f"_it_{name}",
        dscp=None,
        reason=f"connection {name}",
        connection=name,
        connections=ParticipantConnections(urls=urls),
    )


def test_planned_connections_are_made_at_connect(driver: Driver, active: Active) -> None:
    net = planned_connection("net", UDP)
    node = active(
        Hearing,
        subscription("in", participant=net.name),
        publisher("out", participant=net.name),
        publisher("map"),
        participants=(net, planned_connection("spare", OTHER_UDP)),
    )
    assert [(each.name, each.urls, each.mappings) for each in node.connections] == [
        ("", (), ("publishers/map",)),
        ("net", (UDP,), ("subscriptions/in", "publishers/out")),
        ("spare", (OTHER_UDP,), ()),
    ]


def test_a_planned_connection_that_cannot_be_made_fails_connect_and_leaves_none(
    driver: Driver, active: Active
) -> None:
    node = active(
        Talking,
        publisher("map"),
        publisher("out", participant="_it_net"),
        to="configure",
        participants=(
            planned_connection("first", OTHER_UDP),
            planned_connection("net", "udpv4://192.0.2.1"),
        ),
    )
    result = driver.run(node.lifecycle.change, "connect")
    assert result.error.startswith("cannot connect /it to 'net' (udpv4://192.0.2.1): ")
    assert "192.0.2.1" in result.error
    assert {each for _, each in node.mappings} == {None}
    assert [(each.name, bool(each.error)) for each in node.connections] == [
        ("", False),
        ("net", True),
    ]


_ALONE = """
from tests.ros.node.planning import planned, publisher
from lifecycle import LifecycleNode, run
from lifecycle.plan.model import ParticipantConnections, PlannedParticipant

class It(LifecycleNode):
    def on_activate(self):
        for each in self.connections:
            print(each.name, *each.urls, *each.mappings, flush=True)

spec = planned(
    "it",
    publisher("out", participant="_it_net"),
    publisher("map"),
    connections=ParticipantConnections(urls=("shm://",)),
    participants=(
        PlannedParticipant(
            name="_it_net",
            dscp=None,
            reason="connection net",
            connection="net",
            connections=ParticipantConnections(urls=("udpv4://127.0.0.1",)),
        ),
    ),
)
run(It, lifecycle="auto", spec=spec)
"""


def test_a_node_in_a_terminal_is_connected_as_its_plan_says(fresh_domain: int) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", _ALONE],
        cwd=Path(__file__).parents[3],
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        own = (each for each in process.stdout if not each.startswith("/it: "))
        lines = [next(own) for _ in range(2)]
        process.terminate()
        assert process.wait(30) == 0
    assert lines == [" shm:// publishers/map\n", f"net {UDP} publishers/out\n"]


def test_endpoints_are_remapped_while_the_node_runs(driver: Driver, active: Active) -> None:
    node = active(Everything, subscription("in"), publisher("out"), server("reset"))
    got: list[str] = []
    driver.node.create_subscription(String, "/elsewhere", lambda m: got.append(m.data), 10)
    node.remap("out", "elsewhere")
    node.remap("subscriptions/in", "/more")
    node.remap("reset", "again")
    report = configuration(driver).endpoints[1]
    assert (report.name, report.resolved) == ("out", "/elsewhere")
    out = node.publisher("out")
    driver.spin_until(lambda: out.get_subscription_count() == 1)
    out.publish(String(data="x"))
    driver.spin_until(lambda: got == ["x"])
    sender = driver.node.create_publisher(String, "/more", 10)
    driver.spin_until(lambda: sender.get_subscription_count() == 1)
    sender.publish(String(data="y"))
    driver.spin_until(lambda: node.heard == ["y"])
    assert driver.call(Trigger, "/again", Trigger.Request()).message == "was reset"
    node.remap("out", "")
    driver.spin_until(lambda: driver.node.count_publishers("/out") == 1)


def test_a_name_that_cannot_be_is_refused(active: Active) -> None:
    node = active(Talking, publisher("out"))
    with pytest.raises(Exception, match="cannot ") as error:
        node.remap("out", "not a name")
    assert str(error.value) == (
        "cannot call publisher 'out' 'not a name': failed to resolve name: topic name must "
        "not contain characters other than alphanumerics, '_', '~', '{', or '}'"
    )
    assert node.mappings == (("publishers/out", ""),)
