"""What flow needs come to: marks, classes, datagrams, and who shares a participant."""

from __future__ import annotations

from pathlib import Path

import pytest
from msgspec.structs import replace

from lifecycle.manifest.flows import FlowNeeds
from lifecycle.manifest.loading import load
from lifecycle.manifest.model import (
    EndpointKind,
    FlowNeed,
    FlowTransport,
    Machine,
    Network,
    Node,
)
from lifecycle.network.dscp import TransportPriorityMapping
from lifecycle.network.five_qi import five_qi_of
from lifecycle.network.nfe import UniqueRequirement
from lifecycle.plan.build import build_plan
from lifecycle.plan.model import PlannedNode, PlannedParticipant
from tests.builders import at, link, manifest, need, node, publisher, subscription

PUB, SUB = EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION
STRICTLY = UniqueRequirement.STRICTLY_REQUIRED
OPTIONALLY = UniqueRequirement.OPTIONALLY_REQUIRED
NETWORK = FlowTransport.NETWORK
CORPUS = Path(__file__).parents[2] / "corpus" / "valid"


def planned(only: Node, **rest: object) -> PlannedNode:
    return build_plan(manifest(only, **rest), environment={}).nodes[0]


def extra(*needs: FlowNeed) -> tuple[PlannedParticipant, ...]:
    """The participants of one node whose publishers have these needs."""
    only = node("n", *(publisher(each.name) for each in needs), needs=needs)
    return planned(only).participants


def carried(*needs: FlowNeed) -> list[tuple[str, ...]]:
    only = planned(node("n", *(publisher(each.name) for each in needs), needs=needs))
    return [
        tuple(end.name for end in only.endpoints if end.participant == each.name)
        for each in only.participants
    ]


# --- as few participants as meet every need


def test_publishers_that_ask_for_nothing_stay_in_the_node_s_own_participant():
    assert extra(need(PUB, "a"), need(PUB, "b", UniqueRequirement.SYSTEM_DEFAULT)) == ()


def test_publishers_of_one_class_share_and_of_two_classes_do_not():
    assert carried(
        need(PUB, "a", dscp=46),
        need(PUB, "b", dscp=8),
        need(PUB, "c", dscp=46),
        need(PUB, "d", transport=NETWORK),
        need(PUB, "e", dscp=46, transport=NETWORK),
        need(PUB, "f", dscp=46, non_blocking_send=True),
        need(PUB, "g", transport=NETWORK),
    ) == [("a", "c"), ("b",), ("d", "g"), ("e",), ("f",)]


@pytest.mark.parametrize("unique", [STRICTLY, OPTIONALLY])
def test_a_unique_publisher_shares_with_none_even_of_its_class(unique: UniqueRequirement):
    assert carried(
        need(PUB, "a", unique, dscp=46), need(PUB, "b", dscp=46), need(PUB, "c", unique, dscp=46)
    ) == [("a",), ("b",), ("c",)]


def test_the_smaller_datagram_serves_all_of_a_class():
    (only,) = extra(
        need(PUB, "small", dscp=46, max_message_size=100),
        need(PUB, "large", dscp=46, max_message_size=60_000),
    )
    assert only.max_datagram_bytes == 1400


@pytest.mark.parametrize(
    ("priority", "mapping", "dscp"),
    [
        (184, None, 46),  # without a mapping, the priority is the TOS byte
        (0xB8, TransportPriorityMapping(mask=0xFF), 46),
        (0, TransportPriorityMapping(mask=0x03, high=0x03), 0),
        (3, TransportPriorityMapping(mask=0x03, high=0xFC), 63),
        (184, TransportPriorityMapping(mask=0), None),
        (185, None, None),  # ECN bits
    ],
)
def test_a_transport_priority_becomes_a_dscp(
    priority: int, mapping: TransportPriorityMapping | None, dscp: int | None
):
    marked = node("n", publisher("a"), needs=[need(PUB, "a", transport_priority=priority)])
    made = replace(manifest(marked), network=Network(transport_priority_mapping=mapping))
    (found,) = FlowNeeds(made).of_node(marked)
    assert found.dscp == dscp


def test_a_priority_and_a_dscp_that_come_to_the_same_share():
    assert carried(need(PUB, "a", dscp=46), need(PUB, "b", transport_priority=184)) == [("a", "b")]


def test_a_node_whose_own_participant_is_on_the_network_needs_no_other_for_it():
    only = node(
        "n",
        publisher("a"),
        publisher("c"),
        subscription("b"),
        needs=[
            need(PUB, "a", transport=NETWORK),
            need(PUB, "c", dscp=46),
            need(SUB, "b", transport=NETWORK),
        ],
    )
    found = planned(only)
    assert found.transports == ("udpv4",)
    assert [each.transports for each in found.participants] == [("udpv4",)]
    assert [each.name for each in found.endpoints if each.participant] == ["c"]


def test_publishers_of_one_5qi_share_and_of_two_do_not():
    assert carried(
        need(PUB, "a", five_qi=82), need(PUB, "b", five_qi=85), need(PUB, "c", five_qi=82)
    ) == [("a", "c"), ("b",)]


# --- datagrams


@pytest.mark.parametrize(
    ("size", "address", "declared", "limit"),
    [
        (1368, "10.0.0.1", None, None),
        (1369, "10.0.0.1", None, 1400),
        (1348, "fd00::1", None, None),
        (1349, "fd00::1", None, 1400),
        (1369, "", None, 1400),
        (1200, "10.0.0.1", 1250, 1250),
        (1100, "10.0.0.1", 1250, None),
        (None, "10.0.0.1", None, None),
        (None, "10.0.0.1", 1250, 1250),  # of unknown size, and the path is narrow
        (8000, "10.0.0.1", 8972, None),  # jumbo frames
    ],
)
def test_a_prioritised_publisher_gets_datagrams_that_ip_leaves_whole(
    size: int | None, address: str, declared: int | None, limit: int | None
):
    only = node(
        "n",
        publisher("a"),
        needs=[need(PUB, "a", dscp=46, max_message_size=size)],
        machine="m",
    )
    found = planned(
        only,
        machines=(Machine(name="m", address=address, at=at(1)),),
        network=Network(max_datagram_bytes=declared),
    )
    assert [each.max_datagram_bytes for each in found.participants] == [limit]


@pytest.mark.parametrize(
    "asks", [{"dscp": 46}, {"five_qi": 9}, {"unique": STRICTLY}, {"unique": OPTIONALLY}]
)
def test_prioritised_is_what_is_marked_has_a_class_or_is_unique(asks: dict[str, object]):
    (only,) = extra(need(PUB, "a", max_message_size=9000, **asks))
    assert only.max_datagram_bytes == 1400


def test_a_flow_that_no_network_is_to_prefer_may_be_fragmented():
    assert extra(need(PUB, "a", max_message_size=9000)) == ()


def test_network_transport_is_ipv6_where_the_machine_s_address_is():
    for address, transports in (
        ("10.0.0.1", ("udpv4",)),
        ("fd00::1", ("udpv6",)),
        ("", ("udpv4",)),
    ):
        only = node("n", publisher("a"), needs=[need(PUB, "a", transport=NETWORK)], machine="m")
        found = planned(only, machines=(Machine(name="m", address=address, at=at(1)),))
        assert [each.transports for each in found.participants] == [transports]


# --- 5QI


def resolved(flow: FlowNeed, *links: object):
    only = node("n", publisher("a"), needs=[flow])
    return FlowNeeds(manifest(only, links=links)).of("n", PUB, "a")


def test_auto_takes_the_shortest_delay_of_the_links_of_its_topic():
    links = [link("/a", "n", "x", max_delay_ms=300.0), link("/a", "n", "y", max_delay_ms=100.0)]
    each = resolved(need(PUB, "a", five_qi_auto=True), *links)
    assert each.max_delay_ms == 100.0
    assert "keeps max_delay_ms 100" in each.flow_class.reason


def test_a_declared_rate_asks_for_a_class_that_guarantees_one():
    for rate, guaranteed in ((None, False), (5.0, True)):
        each = resolved(need(PUB, "a", five_qi_auto=True, max_delay_ms=300.0, rate_hz=rate))
        assert five_qi_of(each.five_qi).resource_type.guarantees_rate is guaranteed


def test_without_a_rate_a_class_that_guarantees_one_is_the_last_resort():
    each = resolved(need(PUB, "a", five_qi_auto=True, max_delay_ms=5.0))
    assert five_qi_of(each.five_qi).resource_type.guarantees_rate


def test_a_written_5qi_is_kept_with_what_it_does_not_keep():
    each = resolved(need(PUB, "a", five_qi=3, max_delay_ms=5.0, loss=1e-6))
    assert each.five_qi == 3
    assert [field for field, _ in each.flow_class.issues] == ["max_delay_ms", "loss"]


# --- through the loader


def test_every_key_of_flow_needs_becomes_its_field(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(CORPUS)
    system = load("flows_every_key.lifecycle.yaml").manifest
    network = system.network
    assert network.max_datagram_bytes == 1300
    video, pose, alarm, log = system.nodes[0].flows
    assert (video.unique, video.transport_priority, video.enforce) == (STRICTLY, 184, False)
    assert (video.max_message_size, video.transport, video.non_blocking_send) == (
        60000,
        NETWORK,
        True,
    )
    assert (pose.five_qi, pose.five_qi_auto) == (None, True)
    assert (pose.max_delay_ms, pose.loss, pose.rate_hz) == (10.0, 1e-4, 50.0)
    assert (alarm.five_qi, alarm.five_qi_auto, alarm.dscp) == (82, False, None)
    assert (log.dscp, log.transport, log.non_blocking_send) == (8, FlowTransport.ANY, False)
    assert system.nodes[1].flows[0].transport is NETWORK
