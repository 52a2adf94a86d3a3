"""What the state of the graph holds, when it reads a node again, and what it answers."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import pytest
from simulated import (
    ANSWER_S,
    ManualScheduler,
    Network,
    Reader,
    System,
    configuration,
    endpoint,
)

from lifecycle.graph.events import GraphEvents
from lifecycle.graph.messages import GraphMessage, Heartbeat, Joined, MappingLost, encode
from lifecycle.graph.model import End, GraphChange, NodeLiveliness, NodeView, link, match_ends
from lifecycle.graph.state import GraphState
from lifecycle.manifest.model import EndpointKind
from lifecycle.manifest.qos import QosProfile, Reliability
from lifecycle.network.nfe import TransportProtocol
from lifecycle.verify.observation import EndpointReport, Identity, NodeConfiguration
from lifecycle.verify.outcome import Outcome
from tests.builders import nfe

PUBLISHER, SUBSCRIPTION = EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION


class Followed:
    """A system without accidents, one reader, and the changes that it told."""

    def __init__(self) -> None:
        self.system = System()
        self.reader = Reader(self.system)
        self.state = self.reader.state
        self.changes: list[GraphChange] = []
        self.state.on_change(self.changes.append)

    def settle(self) -> None:
        self.system.scheduler.advance(3 * ANSWER_S)

    def change(self) -> GraphChange:
        """Return the one change since the last call."""
        self.settle()
        (change,) = self.changes
        self.changes.clear()
        return change


@pytest.fixture
def followed() -> Followed:
    followed = Followed()
    followed.system.start("/a", endpoints=2)
    followed.settle()
    followed.changes.clear()
    return followed


def test_a_node_that_joins_is_read_once_and_heartbeats_read_nothing(followed: Followed) -> None:
    assert followed.system.reads == 1
    followed.system.scheduler.advance(60.0)
    assert (followed.system.reads, followed.changes) == (1, [])


def test_joining_and_being_read_are_two_changes() -> None:
    followed = Followed()
    node = followed.system.start("/a", endpoints=2)
    followed.settle()
    joined, read = followed.changes
    assert (joined.joined, joined.node, joined.endpoints.added) == (True, "/a", ())
    assert (read.joined, read.endpoints.added) == (False, node.truth.endpoints)


def test_an_endpoint_more_is_told_as_exactly_that(followed: Followed) -> None:
    node = followed.system.nodes["/a"]
    node.add_endpoint("/new")
    change = followed.change()
    assert change.endpoints.added == (node.truth.endpoints[-1],)
    assert (change.endpoints.removed, change.endpoints.changed) == ((), ())
    assert not change.state_changed
    assert [end.node.name for end in followed.state.publishers_of("/new")] == ["/a"]


def test_one_change_reads_one_node_however_many_there_are(followed: Followed) -> None:
    for number in range(50):
        followed.system.start(f"/n{number}", endpoints=2)
    followed.settle()
    reads = followed.system.reads
    followed.system.nodes["/n7"].remove_endpoint()
    followed.settle()
    assert followed.system.reads == reads + 1


def test_states_matches_and_connections_are_learnt_without_reading(followed: Followed) -> None:
    reporter = followed.system.nodes["/a"].reporter
    reads = followed.system.reads
    reporter.state_changed("active", connected=True)
    assert followed.change().state_changed
    reporter.connection_established("net", ("shm://",))
    established = followed.change()
    assert [each.name for each in established.connections] == ["net"]
    reporter.connection_lost("net", error="unplugged")
    (lost,) = followed.change().connections
    assert (lost.established, lost.error, lost.urls) == (False, "unplugged", ("shm://",))
    reporter.connection_lost("net")
    assert followed.change().disconnected == ("net",)
    reporter.mapping_established("publishers/e0", "net", matched=2)
    (mapped,) = followed.change().endpoints.changed
    assert (mapped.connection, mapped.matched, mapped.mapped) == ("net", 2, True)
    reporter.mapping_lost("publishers/e0", "net", matched=1)
    (mapped,) = followed.change().endpoints.changed
    assert (mapped.connection, mapped.matched, mapped.mapped) == ("net", 1, True)
    reporter.mapping_lost("publishers/e0", "net", error="unplugged")
    (mapped,) = followed.change().endpoints.changed
    assert (mapped.connection, mapped.mapped, mapped.error) == ("", False, "unplugged")
    assert followed.system.reads == reads


def test_an_endpoint_that_is_handed_over_stays_where_it_is_when_the_old_connection_loses_it(
    followed: Followed,
) -> None:
    reporter = followed.system.nodes["/a"].reporter
    reporter.mapping_established("publishers/e0", "", matched=1)
    followed.settle()
    reporter.mapping_established("publishers/e0", "net", matched=1)
    reporter.mapping_lost("publishers/e0", "", matched=0)
    reporter.mapping_lost("publishers/e0", "")
    followed.settle()
    view = followed.state.node("/a")
    assert view is not None
    assert view.configuration is not None
    (mapped,) = (each for each in view.configuration.endpoints if each.name == "e0")
    assert (mapped.connection, mapped.matched, mapped.mapped) == ("net", 1, True)


def test_what_is_told_while_a_node_is_read_is_not_undone_by_the_answer(
    followed: Followed,
) -> None:
    node = followed.system.nodes["/a"]
    node.add_endpoint("/new")
    old = node.truth
    # The answer was given already when the state changes, and comes later.
    followed.system.scheduler.advance(ANSWER_S)
    node.change_state("active")
    followed.settle()
    seen = followed.state.node("/a")
    assert seen is not None
    assert seen.state == "active"
    assert seen.configuration == dataclasses.replace(old, state="active")


class Asked:
    """A state whose questions the test answers itself."""

    def __init__(self) -> None:
        self.scheduler = ManualScheduler()
        network = Network(self.scheduler)
        self._wire = network.transport()
        self.questions: list[Callable[[NodeConfiguration | None], None]] = []
        events = GraphEvents(network.transport(), self.scheduler)
        self.state = GraphState(events, lambda _, done: self.questions.append(done))

    def say(self, type_: type[GraphMessage], sequence: int, incarnation: str, **more: Any) -> None:
        header = {"node": "/a", "incarnation": incarnation, "sequence": sequence}
        self._wire.send(encode(type_(**header, **more)))


def test_an_answer_of_the_instance_before_is_not_taken() -> None:
    asked = Asked()
    asked.say(Joined, 1, "1", checksum="x")
    asked.say(Joined, 1, "2", checksum="y")
    before, now = asked.questions
    before(configuration("/a", endpoint(1, "/old")))
    assert asked.state.topics() == ()
    now(configuration("/a", endpoint(1, "/new")))
    assert asked.state.topics() == ("/new",)


def test_what_was_lost_while_a_node_was_read_has_it_read_once_more() -> None:
    asked = Asked()
    asked.say(Joined, 1, "1", checksum="x")
    asked.say(Heartbeat, 2, "1", checksum="x")
    asked.scheduler.advance(0.2)  # 2 is lost
    assert len(asked.questions) == 1
    answer = dataclasses.replace(configuration("/a"), checksum="x")
    asked.questions[0](answer)
    assert len(asked.questions) == 2
    asked.questions[1](answer)
    assert len(asked.questions) == 2


def test_what_came_before_a_gap_is_not_put_on_top_of_what_is_read_after_it() -> None:
    asked = Asked()
    asked.say(Joined, 1, "1", checksum="x")
    mapped = dataclasses.replace(endpoint(1, "/t"), matched=0)
    held = dataclasses.replace(configuration("/a", mapped), checksum="x")
    asked.questions[0](held)
    asked.say(MappingLost, 3, "1", endpoint="publishers/e1", matched=0)  # 2 and 4 are lost
    asked.say(Heartbeat, 4, "1", checksum="x")
    asked.scheduler.advance(0.2)
    assert len(asked.questions) == 2
    true = dataclasses.replace(held, endpoints=(dataclasses.replace(mapped, matched=1),))
    asked.questions[1](dataclasses.replace(true, state=""))
    assert [each.endpoint.matched for each in asked.state.publishers_of("/t")] == [1]


def test_a_node_that_could_not_be_read_is_read_at_the_next_heartbeat_or_retry() -> None:
    followed = Followed()
    followed.system.network.loss = 0.999999
    followed.system.start("/a", endpoints=2)
    followed.system.network.loss = 0.0
    node = followed.system.nodes["/a"]
    followed.system.network.partition((node.transport, followed.reader.transport))
    node.reporter.announce()
    assert followed.state.node("/a") is not None
    followed.system.network.partition((node.transport,))  # messages come, answers do not
    followed.system.scheduler.advance(1.5)
    assert followed.state.connections_of("/a") == ()
    assert followed.state.node("/a").configuration is None  # type: ignore[union-attr]
    followed.system.network.heal()
    followed.state.retry()
    followed.settle()
    assert followed.state.node("/a").configuration == node.truth  # type: ignore[union-attr]


def test_a_node_that_leaves_takes_everything_along(followed: Followed) -> None:
    endpoints = followed.system.nodes["/a"].truth.endpoints
    followed.system.leave("/a")
    change = followed.change()
    assert (change.left, change.endpoints.removed) == (True, endpoints)
    assert followed.state.nodes() == ()
    assert followed.state.topics() == ()


def test_a_configuration_may_be_given_instead_of_read(followed: Followed) -> None:
    given = configuration("/given", endpoint(1, "/g"))
    followed.state.put_configuration(given)
    followed.settle()
    seen = followed.state.node("/given")
    assert seen is not None
    assert (seen.configuration, seen.incarnation) == (given, "")
    assert [end.node.name for end in followed.state.publishers_of("/g")] == ["/given"]


def test_a_match_of_which_no_message_tells_is_not_kept(followed: Followed) -> None:
    client = dataclasses.replace(
        endpoint(1, "/ask"), kind=EndpointKind.SERVICE_CLIENT, server_matched=True
    )
    followed.state.put_configuration(configuration("/given", client))
    followed.settle()
    seen = followed.state.node("/given")
    assert seen is not None
    assert seen.endpoints == (dataclasses.replace(client, server_matched=None),)


UDP = nfe("10.0.0.2", 7411)
TCP = dataclasses.replace(UDP, transport_protocol=TransportProtocol.TCP)


def end(
    name: str,
    kind: EndpointKind,
    *,
    liveliness: NodeLiveliness = NodeLiveliness.ALIVE,
    **options: Any,
) -> End:
    report = EndpointReport(
        **{
            "kind": kind,
            "name": "e",
            "resolved": "/t",
            "type": "std_msgs/msg/String",
            "mapped": True,
            "nfes": (UDP,),
            **options,
        }
    )
    described = dataclasses.replace(
        configuration(name, report),
        identity=Identity(machine_id=name, process_id=1, node_id=name),
    )
    view = NodeView(name=name, liveliness=liveliness, state="active", configuration=described)
    return End(node=view, endpoint=report)


def judged(
    publisher: dict[str, Any], subscription: dict[str, Any], *others: End
) -> tuple[Outcome, str, str]:
    one, other = end("/a", PUBLISHER, **publisher), end("/b", SUBSCRIPTION, **subscription)
    ends = {
        "publishers": match_ends((one, *others)),
        "subscriptions": match_ends((other,)),
    }
    found = link("/t", one, other, **ends)
    return found.connected, found.reason, found.transport


@pytest.mark.parametrize(
    ("publisher", "subscription", "outcome", "reason"),
    [
        ({"matched": 1}, {}, Outcome.OK, ""),
        ({"matched": 0}, {"matched": 1}, Outcome.VIOLATED, "the publisher matched nobody"),
        ({}, {}, Outcome.UNVERIFIABLE, "neither end reports whom it is matched with"),
        ({"matched": 0}, {}, Outcome.VIOLATED, "the publisher matched nobody"),
        (
            {"matched": 2},
            {},
            Outcome.UNVERIFIABLE,
            "the publisher matched 2 of 1, and does not tell which",
        ),
        ({"mapped": False}, {}, Outcome.VIOLATED, "/a has not mapped it onto a connection"),
        ({}, {"error": "no route"}, Outcome.VIOLATED, "/b: no route"),
        ({}, {"liveliness": NodeLiveliness.SILENT}, Outcome.VIOLATED, "/b is silent"),
        ({}, {"nfes": (TCP,)}, Outcome.VIOLATED, "they have no transport in common"),
        (
            {"type": "std_msgs/msg/Empty"},
            {},
            Outcome.VIOLATED,
            "the types differ, std_msgs/msg/Empty and std_msgs/msg/String",
        ),
        (
            {"qos": QosProfile(reliability=Reliability.BEST_EFFORT)},
            {"qos": QosProfile(reliability=Reliability.RELIABLE)},
            Outcome.VIOLATED,
            "the QoS is incompatible",
        ),
    ],
)
def test_two_ends_are_connected_as_far_as_they_tell(
    publisher: dict[str, Any], subscription: dict[str, Any], outcome: Outcome, reason: str
) -> None:
    assert judged(publisher, subscription)[:2] == (outcome, reason)


def test_a_count_is_that_of_all_who_can_match_as_the_verification_has_it() -> None:
    more = end("/c", PUBLISHER)
    outcome, reason, _ = judged({}, {"matched": 1}, more)
    assert (outcome, reason) == (Outcome.VIOLATED, "the subscription matched 1 of 2")
    assert judged({}, {"matched": 2}, more)[0] is Outcome.OK
    silent = end("/c", PUBLISHER, liveliness=NodeLiveliness.SILENT)
    assert judged({}, {"matched": 1}, silent)[0] is Outcome.OK
    other = end("/c", PUBLISHER, type="std_msgs/msg/Empty")
    assert judged({}, {"matched": 1}, other)[0] is Outcome.OK


def test_a_link_says_by_which_flow_and_connections() -> None:
    publisher = end("/a", PUBLISHER, connection="net", matched=1)
    subscription = end("/b", SUBSCRIPTION)
    found = link(
        "/t",
        publisher,
        subscription,
        publishers=match_ends([publisher]),
        subscriptions=match_ends([subscription]),
    )
    assert (found.transport, found.connections) == ("udpv4", ("net", ""))
    assert [(each.destination_address, each.destination_port) for each in found.flows] == [
        ("10.0.0.2", 7411)
    ]


def test_the_state_links_what_two_nodes_have_of_a_topic(followed: Followed) -> None:
    publisher = end("/p", PUBLISHER, matched=1).node.configuration
    subscription = end("/s", SUBSCRIPTION).node.configuration
    assert publisher is not None
    assert subscription is not None
    followed.state.put_configuration(publisher)
    followed.state.put_configuration(subscription)
    followed.settle()
    (found,) = followed.state.connected("/t", "/p", "/s")
    assert (found.connected, found.transport) == (Outcome.OK, "udpv4")
    assert followed.state.connected("/t", "/s", "/p") == ()
    assert followed.state.flows("/t") == (found,)
    assert found in followed.state.flows()
