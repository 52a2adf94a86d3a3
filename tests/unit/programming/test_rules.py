"""Flow rules: verified flows become rules, everything else is named with its reason."""

from __future__ import annotations

import re

import pytest
from msgspec.structs import replace

from lifecycle.network.five_qi import dscp_mapping
from lifecycle.network.nfe import TransportProtocol
from lifecycle.plan.model import PlannedNode
from lifecycle.programming.rules import FlowRule, Treatment, flow_rules
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import FlowReport
from tests.builders import nfe
from tests.unit.programming.flow_samples import SHM, VIDEO, plan, report, rule

UNICAST = "use one unicast address without a zone, such as 10.77.0.1"


def left(*reports: FlowReport, **rest: object) -> list[str]:
    found = flow_rules(reports, plan(), **rest)
    assert found.rules == ()
    return [each.partition(": ")[2] for each in found.left_out]


def only(*reports: FlowReport, **rest: object) -> FlowRule:
    found = flow_rules(reports, rest.pop("plan", plan()), **rest)
    assert found.left_out == ()
    (made,) = found.rules
    return made


def test_a_verified_flow_is_a_rule_with_what_its_manifest_asks() -> None:
    assert only(report(dscp=46, max_delay_ms=5.0)) == FlowRule(
        key="/robot/video /robot/camera → /viewer udp 10.77.0.2",
        names=(("/robot/video", "/robot/camera", "/viewer"),),
        transport_protocol=TransportProtocol.UDP,
        source_address="10.77.0.1",
        source_port=45000,
        destination_address="10.77.0.2",
        destination_port=7001,
        dscp=46,
        five_qi=85,
        max_delay_ms=5.0,
    )


@pytest.mark.parametrize("outcome", [Outcome.VIOLATED, Outcome.UNVERIFIABLE])
def test_what_is_not_verified_is_not_programmed(outcome: Outcome) -> None:
    assert left(report(outcome=outcome)) == [f"not verified: its verdict is {outcome.value}"]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"source": ()}, "its network flow endpoints are not known"),
        ({"destination": ()}, "its network flow endpoints are not known"),
        (
            {"source": (SHM,), "destination": (SHM,)},
            "shared memory: no packet that a network could see",
        ),
        ({"effective_transport": "shm"}, "shared memory: no packet that a network could see"),
        (
            {"effective_transport": "intraprocess"},
            "one process: no packet that a network could see",
        ),
        (
            {"effective_transport": "none", "source": (nfe("fd09::1", 45000),)},
            "its two ends have no IP transport in common",
        ),
        ({"destination": (nfe("239.255.0.1", 7401),)}, "group 239.255.0.1: no unicast 5-tuple"),
        (
            {"destination": (nfe("127.0.0.1", 7001),)},
            "loopback: never leaves the subscription's machine",
        ),
        ({"source": (nfe("0.0.0.0", 0),)}, "cannot use port 0; use 1 to 65535"),
        (
            {"destination": (nfe("0.0.0.0", 7001),)},
            f"cannot use address '0.0.0.0'; {UNICAST}",
        ),
    ],
)
def test_what_no_network_can_match_is_left_out(change: dict[str, object], reason: str) -> None:
    assert left(report(**change)) == [reason]


def test_a_flow_that_asks_for_nothing_is_left_out() -> None:
    assert left(report("/robot/status")) == ["neither a dscp nor a five_qi"]


def test_two_flows_of_one_5_tuple_that_ask_for_different_things_are_both_left_out() -> None:
    found = flow_rules([report(), report("/robot/status")], plan())
    assert found.rules == ()
    assert [*found.left_out] == [
        (
            "/robot/video /robot/camera → /viewer: shares its 5-tuple with /robot/status "
            "/robot/camera → /viewer, which is to be treated differently; make one of them unique"
        ),
        (
            "/robot/status /robot/camera → /viewer: shares its 5-tuple with /robot/video "
            "/robot/camera → /viewer, which is to be treated differently; make one of them unique"
        ),
    ]


def test_two_flows_of_one_5_tuple_that_ask_for_the_same_are_one_rule() -> None:
    sent = (nfe("10.77.0.1", 45000),)
    made = only(
        report(max_delay_ms=20.0, source=sent),
        report(max_delay_ms=9.0, source=sent, subscription="/other"),
    )
    assert [each[2] for each in made.names] == ["/other", "/viewer"]
    assert made.max_delay_ms == 9.0


def test_shared_memory_between_hosts_is_no_reason_to_leave_a_flow_out() -> None:
    ends = {"source": (SHM, nfe("0.0.0.0", 45000)), "destination": (SHM, nfe("10.77.0.2", 7001))}
    made = only(report(**ends, effective_transport="udpv4"))
    assert made.describe() == "udp 10.77.0.1:45000 → 10.77.0.2:7001"
    told = flow_rules([report(**ends)], plan())
    assert [each.describe() for each in told.rules] == [made.describe()]
    assert [each.partition(": ")[2] for each in told.left_out] == [
        "shared memory: no packet that a network could see"
    ]


def test_a_sender_without_a_known_address_is_matched_by_port_and_destination() -> None:
    made = only(report(), plan=plan(robot=""))
    assert made.source_address == ""
    assert made.describe() == "udp *:45000 → 10.77.0.2:7001"


def test_another_interface_of_the_machine_would_send_from_another_address() -> None:
    made = only(report(destination=(nfe("192.168.1.2", 7001),)))
    assert made.source_address == ""


def test_an_observed_source_address_is_believed_before_a_declared_one() -> None:
    def observe(node: PlannedNode, destination: str) -> str:
        assert (node.full_name, destination) == ("/robot/camera", "10.77.0.2")
        return "10.77.0.9"

    assert only(report(), source_address=observe).source_address == "10.77.0.9"


def test_a_zone_is_not_in_the_packet_and_not_in_the_rule() -> None:
    made = only(report(source=(nfe("::", 45000),), destination=(nfe("fe80::2%eth0", 7001),)))
    assert made.describe() == "udp *:45000 → [fe80::2]:7001"


def test_each_address_of_a_subscription_is_a_rule() -> None:
    ends = (nfe("10.77.0.2", 7001), nfe("192.168.1.2", 7001))
    found = flow_rules([report(destination=ends)], plan())
    assert [each.key for each in found.rules] == [
        "/robot/video /robot/camera → /viewer udp 10.77.0.2",
        "/robot/video /robot/camera → /viewer udp 192.168.1.2",
    ]


def test_a_mapping_gives_the_dscp_where_only_a_5qi_is_asked_for() -> None:
    bare = plan()
    camera = bare.nodes[0]
    video, status = camera.endpoints[0], camera.endpoints[1]
    changed = replace(camera, endpoints=(replace(video, dscp=None), status))
    only_5qi = replace(bare, nodes=(changed, *bare.nodes[1:]))
    assert only(report(), plan=only_5qi).dscp is None
    mapping = dscp_mapping("azure_private_5g_core")
    assert only(report(), plan=only_5qi, treatment=Treatment(mapping=mapping)).dscp == 18
    assert only(report(), treatment=Treatment(mapping=mapping)).dscp == 46


def test_flow_labels_are_given_to_ipv6_only_and_stay_with_the_5_tuple() -> None:
    v6 = report(source=(nfe("::", 45000),), destination=(nfe("fd09::2", 7001),))
    label = only(v6, treatment=Treatment(label_flows=True)).flow_label
    assert 1 <= label <= 0xFFFFF
    assert only(v6, treatment=Treatment(label_flows=True)).flow_label == label
    assert only(v6).flow_label == 0
    assert only(report(), treatment=Treatment(label_flows=True)).flow_label == 0
    moved = replace(v6, destination=(nfe("fd09::2", 7002),))
    assert only(moved, treatment=Treatment(label_flows=True)).flow_label != label


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"destination_address": "viewer"},
            f"cannot use address 'viewer'; {UNICAST}",
        ),
        (
            {"destination_address": "fe80::1%eth0"},
            f"cannot use address 'fe80::1%eth0'; {UNICAST}",
        ),
        (
            {"source_address": "fd00::1"},
            (
                "cannot filter packets from fd00::1 to 10.9.0.2: one is IPv6, the other IPv4; "
                "use two addresses of one family"
            ),
        ),
        (
            {"flow_label": 1},
            "cannot set flow label 0x1 on IPv4: only IPv6 has one (RFC 6437)",
        ),
    ],
)
def test_a_rule_that_no_filter_could_say_is_refused(
    change: dict[str, object], message: str
) -> None:
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        replace(VIDEO, **change)


def test_a_rule_in_words_says_dscp_and_tos_side_by_side() -> None:
    assert VIDEO.named == "/video /robot/camera → /viewer"
    assert VIDEO.asks == "EF = DSCP 46 = TOS 184 (0xb8), 5QI 85, at most 5 ms"
    assert rule("/x", "*:1", "10.0.0.1:2").asks == "nothing"
