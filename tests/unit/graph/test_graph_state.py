"""What the state of the graph holds, and what it answers."""

from __future__ import annotations

from typing import Any

import pytest
from msgspec.structs import replace

from lifecycle.graph.model import End, GraphChange, NodeView, links
from lifecycle.graph.state import GraphState
from lifecycle.graph.status import NodeStatus, decode, encode
from lifecycle.manifest.model import EndpointKind
from lifecycle.manifest.qos import QosProfile, Reliability
from lifecycle.network.nfe import TransportProtocol
from lifecycle.verify.observation import EndpointReport, Identity, ObservedNode
from lifecycle.verify.outcome import ConnectionReport, Outcome
from tests.builders import configuration, nfe

PUBLISHER, SUBSCRIPTION = EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION


def endpoint(topic: str, **rest: Any) -> EndpointReport:
    return EndpointReport(
        kind=PUBLISHER, name="e", resolved=topic, type="std_msgs/msg/String", mapped=True, **rest
    )


@pytest.fixture
def state() -> GraphState:
    return GraphState(lambda work: work())


@pytest.fixture
def changes(state: GraphState) -> list[GraphChange]:
    told: list[GraphChange] = []
    state.on_change(told.append)
    return told


def test_joining_being_read_and_leaving_are_changes_and_nothing_new_is_none(
    state: GraphState, changes: list[GraphChange]
) -> None:
    read = configuration("/a", endpoint("/t"))
    state.learn(read)  # nobody's
    for _ in range(2):
        state.show("/a")
        state.learn(read)
    joined, was_read = changes
    assert (joined.before, joined.node, list(joined.endpoints())) == (None, "/a", [])
    assert was_read.before == joined.after
    assert list(was_read.endpoints()) == [(None, each) for each in read.endpoints]
    assert (joined.after.state, was_read.after.state) == (None, "inactive")
    state.hide("/a", "gone")
    left = changes[-1]
    assert (left.after, left.reason) == (None, "gone")
    assert list(left.endpoints()) == [(each, None) for each in read.endpoints]
    assert (state.nodes(), state.node("/a")) == ((), None)


def test_a_change_says_exactly_what_is_different(
    state: GraphState, changes: list[GraphChange]
) -> None:
    one, two, twin = endpoint("/one"), endpoint("/two"), endpoint("/two", gid="2")
    net = ConnectionReport(name="net", established=True)
    state.put_configuration(configuration("/a", one, two, connections=(net,)))
    lost = replace(net, established=False)
    now = configuration("/a", replace(two, matched=1), twin, connections=(lost,))
    state.put_configuration(now)
    change = changes[-1]
    assert list(change.endpoints()) == [(one, None), (two, now.endpoints[0]), (None, twin)]
    assert [each.endpoint for each in state.publishers_of("/two")] == list(now.endpoints)
    assert (change.before.connections, change.after.connections) == ((net,), (lost,))


def test_what_a_node_says_of_its_state_counts_more_than_what_was_read(
    state: GraphState, changes: list[GraphChange]
) -> None:
    said = NodeStatus(node="/a", instance="1", state="active", connected=True)
    state.put_status(said)
    state.learn(configuration("/a", state="inactive"))  # asked before it was activated
    view = state.node("/a")
    assert view is not None
    assert (view.state, view.status) == ("active", said)
    assert [each.status_changed for each in changes] == [True, False]


def test_the_last_status_is_all_that_counts_whatever_came_before(state: GraphState) -> None:
    complete = GraphState(lambda work: work())
    said = [NodeStatus(node="/a", instance="1", checksum=str(number)) for number in range(5)]
    for each in said:
        complete.put_status(each)
    state.put_status(said[0])
    state.put_status(said[0])
    state.put_status(said[-1])
    assert state.nodes() == complete.nodes()


def test_statuses_may_be_carried_by_anything(state: GraphState) -> None:
    others = [GraphState(lambda work: work()) for _ in range(3)]

    def broker(data: bytes) -> None:
        for each in (state, *others):
            each.put_status(decode(data))

    for number in range(5):
        broker(encode(NodeStatus(node=f"/n{number}", instance="1", state="active")))
    broker(encode(NodeStatus(node="/n3", instance="1", left=True)))
    assert [each.name for each in state.nodes()] == ["/n0", "/n1", "/n2", "/n4"]
    assert [each.nodes() for each in others] == [state.nodes()] * 3


def test_what_was_given_is_judged_and_shown_until_it_is_dropped(state: GraphState) -> None:
    given = configuration("/given", endpoint("/g"))
    state.put_configuration(given)
    view = state.node("/given")
    assert view is not None
    assert (view.configuration, view.status) == (given, None)
    assert [end.node.name for end in state.publishers_of("/g")] == ["/given"]
    assert state.observation().configurations == (given,)
    state.drop_configuration("/given")
    assert (state.nodes(), state.observation().configurations) == ((), ())


def test_a_node_without_any_endpoint_is_there_by_its_report(state: GraphState) -> None:
    bare, other = configuration("/bare"), configuration("/other", endpoint("/t"))
    state.put_configuration(bare)
    state.put_configuration(other)  # discovery shows what it has, or it is cut off
    seen = state.observation()
    assert [(each.full_name, each.state, each.managed) for each in seen.nodes] == [
        ("/bare", bare.state, True)
    ]
    twice = ObservedNode(full_name="/bare", count=2, managed=True)
    assert [each.count for each in state.observation([twice]).nodes] == [2]
    state.drop_configuration("/bare")
    assert state.observation().nodes == ()


def test_who_asks_for_what_is_known_gets_each_node_and_then_its_changes(state: GraphState) -> None:
    state.put_configuration(configuration("/a", endpoint("/t")))
    told: list[GraphChange] = []
    remove = state.on_change(told.append, known=True)
    assert [(each.before, len(list(each.endpoints()))) for each in told] == [(None, 1)]
    state.show("/b")
    assert [each.node for each in told] == ["/a", "/b"]
    remove()
    state.show("/c")
    assert len(told) == 2


UDP = nfe("10.0.0.2", 7411)
TCP = replace(UDP, transport_protocol=TransportProtocol.TCP)


def end(
    name: str,
    kind: EndpointKind,
    *,
    silent: str = "",
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
    described = replace(
        configuration(name, report),
        identity=Identity(machine_id=name, process_id=1, node_id=name),
    )
    view = NodeView(name=name, silent=silent, configuration=described)
    return End(node=view, endpoint=report)


def judged(
    publisher: dict[str, Any], subscription: dict[str, Any], *others: End
) -> tuple[Outcome, str, str]:
    one, other = end("/a", PUBLISHER, **publisher), end("/b", SUBSCRIPTION, **subscription)
    found = next(links("/t", (one, *others), (other,)))
    return found.connected, found.reason, found.transport


@pytest.mark.parametrize(
    ("publisher", "subscription", "outcome", "reason"),
    [
        ({"matched": 1}, {}, Outcome.OK, ""),
        ({"matched": 0}, {"matched": 1}, Outcome.VIOLATED, "the publisher matched none"),
        ({}, {}, Outcome.UNVERIFIABLE, "neither end reports whom it is matched with"),
        ({"matched": 0}, {}, Outcome.VIOLATED, "the publisher matched none"),
        (
            {"matched": 2},
            {},
            Outcome.UNVERIFIABLE,
            "the publisher matched 2 of 1, and does not tell which",
        ),
        ({"mapped": False}, {}, Outcome.VIOLATED, "/a has not mapped it onto a connection"),
        ({}, {"error": "no route"}, Outcome.VIOLATED, "/b: no route"),
        ({}, {"silent": "gone"}, Outcome.VIOLATED, "/b is silent"),
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
    silent = end("/c", PUBLISHER, silent="gone")
    assert judged({}, {"matched": 1}, silent)[0] is Outcome.OK
    other = end("/c", PUBLISHER, type="std_msgs/msg/Empty")
    assert judged({}, {"matched": 1}, other)[0] is Outcome.OK


def test_the_state_links_what_two_nodes_have_of_a_topic(state: GraphState) -> None:
    publisher = end("/p", PUBLISHER, matched=1).node.configuration
    subscription = end("/s", SUBSCRIPTION).node.configuration
    assert publisher is not None
    assert subscription is not None
    state.put_configuration(publisher)
    state.put_configuration(subscription)
    (found,) = state.flows("/t")
    assert (found.publisher.node.name, found.subscription.node.name) == ("/p", "/s")
    assert (found.connected, found.transport) == (Outcome.OK, "udpv4")
    assert [(each.destination_address, each.destination_port) for each in found.flows] == [
        ("10.0.0.2", 7411)
    ]
    assert state.flows("/other") == ()
