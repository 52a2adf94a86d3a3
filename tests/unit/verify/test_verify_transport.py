"""What carries a flow, and whether that is what it needs."""

from __future__ import annotations

import dataclasses

import pytest

from lifecycle.manifest.model import EndpointKind, FlowTransport, Machine, UniqueHow
from lifecycle.network.nfe import (
    InternetProtocol,
    NetworkFlowEndpoint,
    TransportProtocol,
    UniqueRequirement,
)
from lifecycle.plan import Plan
from lifecycle.verify import Finding, Identity, Outcome, Stage, verify
from lifecycle.verify.transport import carrier
from tests.unit.plan.samples import at, link, need, node, planned, publisher, subscription
from tests.unit.verify.edits import Edit, both, change_configuration, change_node, change_report
from tests.unit.verify.perfect import perfect

PUB, SUB = EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION
NETWORK = FlowTransport.NETWORK
STRICTLY = UniqueRequirement.STRICTLY_REQUIRED


def nfe(transport: str, internet: str, address: str, port: int = 7000) -> NetworkFlowEndpoint:
    return NetworkFlowEndpoint(
        transport_protocol=TransportProtocol(transport),
        internet_protocol=InternetProtocol(internet),
        transport_port=port,
        internet_address=address,
    )


SHM = nfe("unknown", "unknown", "")
UDP4, UDP6 = nfe("udp", "ipv4", "10.0.0.1"), nfe("udp", "ipv6", "fd00::1")
GROUP4 = nfe("udp", "ipv4", "239.255.1.9")
TCP4, TCP6 = nfe("tcp", "ipv4", "10.0.0.1"), nfe("tcp", "ipv6", "fd00::1")


def process(number: int, machine: str = "m") -> Identity:
    return Identity(machine_id=machine, process_id=number, node_id=f"/n@{number}")


@pytest.mark.parametrize(
    ("source", "destination", "publisher", "subscription", "used"),
    [
        ((SHM, UDP4), (SHM, UDP4), process(1), process(2), "shm"),
        ((SHM, UDP4), (SHM, UDP4), process(1), process(2, "other"), "udpv4"),
        ((SHM, UDP4), (SHM, UDP4), process(1), process(1), "intraprocess"),
        ((UDP4,), (UDP4,), process(1), process(1), "intraprocess"),
        ((UDP4,), (UDP4,), process(1), process(1, "other"), "udpv4"),
        ((UDP4,), (SHM, UDP4), process(1), process(2), "udpv4"),
        ((SHM, UDP4), (UDP4,), process(1), process(2), "udpv4"),
        ((UDP6,), (UDP6,), process(1), process(2), "udpv6"),
        ((UDP4, UDP6), (UDP6, UDP4), process(1), process(2), "udpv6"),
        ((TCP4,), (TCP4,), process(1), process(2), "tcpv4"),
        ((TCP6, UDP4), (TCP6,), process(1), process(2), "tcpv6"),
        ((UDP4,), (UDP4, GROUP4), process(1), process(2), "udpm"),
        ((UDP4,), (GROUP4,), process(1), process(2), "udpm"),
        ((SHM, UDP4), (SHM, GROUP4), process(1), process(2), "shm"),
        ((UDP4, TCP4), (GROUP4, TCP4), process(1), process(2, "other"), "tcpv4"),
        ((TCP4,), (GROUP4, TCP4), process(1), process(2), "tcpv4"),
        ((UDP4,), (UDP6,), process(1), process(2), "none"),
        ((SHM,), (SHM,), process(1), process(2, "other"), "none"),
        ((), (UDP4,), process(1), process(2), "unknown"),
        ((UDP4,), (), process(1), process(2), "unknown"),
        ((UDP4,), (UDP4,), None, process(2), "unknown"),
        ((UDP4,), (UDP4,), process(1), None, "unknown"),
    ],
)
def test_what_carries_a_flow_follows_from_process_machine_and_what_both_ends_have(
    source, destination, publisher, subscription, used
):
    assert carrier(source, destination, publisher, subscription) == used


def pair(publishing: FlowTransport, subscribing: FlowTransport, **rest: object) -> Plan:
    return planned(
        node("one", publisher("a"), needs=[need(PUB, "a", transport=publishing)], **rest),
        node("two", subscription("a"), needs=[need(SUB, "a", transport=subscribing)], **rest),
    )


def unchanged(seen):
    return seen


def findings(plan: Plan, edit: Edit) -> list[tuple[str, str, str]]:
    verdict = verify(plan, edit(perfect(plan)), stage=Stage.CONNECTED)
    return [(each.rule, each.outcome.value, each.observed) for each in verdict.findings]


@pytest.mark.parametrize(
    ("publishing", "subscribing"), [(NETWORK, FlowTransport.ANY), (FlowTransport.ANY, NETWORK)]
)
def test_one_end_without_shared_memory_is_enough_for_the_network(publishing, subscribing):
    plan = pair(publishing, subscribing)
    verdict = verify(plan, perfect(plan), stage=Stage.CONNECTED)
    assert verdict.findings == ()
    assert [each.effective_transport for each in verdict.flows] == ["udpv4"]


def test_a_flow_that_needs_no_network_may_go_by_shared_memory():
    plan = pair(FlowTransport.ANY, FlowTransport.ANY)
    verdict = verify(plan, perfect(plan), stage=Stage.CONNECTED)
    assert verdict.findings == ()
    assert [each.effective_transport for each in verdict.flows] == ["shm"]


@pytest.mark.parametrize(
    ("receives", "source"), [((TCP4,), (TCP4,)), ((UDP4,), (UDP4,)), ((GROUP4,), (UDP4,))]
)
def test_a_flow_has_only_those_sockets_of_a_connection_that_carry_it(receives, source):
    plan = pair(NETWORK, FlowTransport.ANY)
    edit = both(
        change_report(PUB, "/a", nfes=(UDP4, TCP4)), change_report(SUB, "/a", nfes=receives)
    )
    (flow,) = verify(plan, edit(perfect(plan)), stage=Stage.CONNECTED).flows
    assert (flow.source, flow.destination) == (source, receives)


@pytest.mark.parametrize(("receives", "dscp"), [((TCP4,), None), ((UDP4,), 46)])
def test_the_mark_of_udp_sockets_is_not_told_of_a_flow_that_tcp_carries(receives, dscp):
    plan = pair(NETWORK, FlowTransport.ANY)
    edit = both(
        change_report(PUB, "/a", nfes=(UDP4, TCP4), dscp=46),
        change_report(SUB, "/a", nfes=receives),
    )
    (flow,) = verify(plan, edit(perfect(plan)), stage=Stage.CONNECTED).flows
    assert flow.dscp == dscp


LISTED = change_report(PUB, "/a", nfes=(SHM, nfe("udp", "ipv4", "0.0.0.0", 40000)))


def test_a_flow_that_needs_the_network_is_violated_by_shared_memory_although_udp_is_listed():
    plan = pair(NETWORK, FlowTransport.ANY)
    verdict = verify(plan, LISTED(perfect(plan)), stage=Stage.CONNECTED)
    assert verdict.findings == (
        Finding(
            rule="flow.wrong-transport",
            outcome=Outcome.VIOLATED,
            subject="/a: /one → /two",
            expected="an IP transport",
            observed="shared memory",
            message="cannot accept the flow /one → /two on /a: it needs the network, and what"
            " carries it is shared memory",
            at="robot.lifecycle.yaml:10:9",
            hint="run both ends in our host and in processes of their own, or drop"
            " `transport: network`",
        ),
    )
    assert [each.outcome for each in verdict.flows] == [Outcome.VIOLATED]


@pytest.mark.parametrize(
    ("plan", "edit", "expected"),
    [
        (
            pair(NETWORK, FlowTransport.ANY),
            both(
                change_configuration("/one", identity=process(1)),
                change_configuration("/two", identity=process(1)),
            ),
            ("flow.wrong-transport", "violated", "handed over inside their process"),
        ),
        (
            pair(NETWORK, FlowTransport.ANY),
            change_report(SUB, "/a", nfes=(UDP6,)),
            ("flow.wrong-transport", "violated", "no transport that both have"),
        ),
        (
            pair(NETWORK, FlowTransport.ANY),
            change_report(PUB, "/a", nfes=None),
            ("flow.wrong-transport", "unverifiable", "not known"),
        ),
    ],
)
def test_what_else_is_no_network(plan: Plan, edit: Edit, expected: tuple[str, str, str]):
    assert findings(plan, edit) == [expected]


MACHINES = (
    Machine(name="m1", address="10.0.0.1", at=at(2)),
    Machine(name="m2", address="10.0.0.2", at=at(2)),
)
BRIDGE = nfe("udp", "ipv4", "172.17.0.1")


def on_two_machines(*, declared: bool) -> Plan:
    plan = planned(
        node("one", subscription("a"), needs=[need(SUB, "a", STRICTLY)], machine="m1"),
        node("two", subscription("b"), needs=[need(SUB, "b", STRICTLY)], machine="m2"),
    )
    return dataclasses.replace(plan, machines=MACHINES) if declared else plan


BOTH_BRIDGED = both(
    change_report(SUB, "/a", nfes=(nfe("udp", "ipv4", "10.0.0.1"), BRIDGE)),
    change_report(SUB, "/b", nfes=(nfe("udp", "ipv4", "10.0.0.2"), BRIDGE)),
)


def test_container_bridges_of_one_address_do_not_make_two_machines_share_a_flow():
    assert findings(on_two_machines(declared=True), BOTH_BRIDGED) == []


def test_without_declared_addresses_equal_addresses_may_be_one():
    assert [rule for rule, _, _ in findings(on_two_machines(declared=False), BOTH_BRIDGED)] == [
        "flow.not-unique",
        "flow.not-unique",
    ]


def test_an_endpoint_that_is_not_on_the_declared_address_is_judged_by_all_that_it_has():
    edit = both(change_report(SUB, "/a", nfes=(BRIDGE,)), change_report(SUB, "/b", nfes=(BRIDGE,)))
    assert [rule for rule, _, _ in findings(on_two_machines(declared=True), edit)] == [
        "flow.not-unique",
        "flow.not-unique",
    ]


def test_a_group_on_the_declared_address_still_counts():
    group = nfe("udp", "ipv4", "239.255.0.1")
    edit = both(
        change_report(SUB, "/a", nfes=(nfe("udp", "ipv4", "10.0.0.1"), group)),
        change_report(SUB, "/b", nfes=(nfe("udp", "ipv4", "10.0.0.2"), group)),
    )
    assert [rule for rule, _, _ in findings(on_two_machines(declared=True), edit)] == [
        "flow.not-unique",
        "flow.not-unique",
    ]


# --- nodes that another supervisor brings up

ELSEWHERE = planned(
    node("one", publisher("a"), machine="m1"),
    node("two", subscription("a"), machine="m2"),
    links=[link("/a", "one", "two", unique=UniqueHow.NOT)],
)
ACTIVE = both(change_node("/two", state="active"), change_configuration("/two", state="active"))


def rules_with(machines: frozenset[str] | None, edit: Edit, stage: Stage = Stage.CONNECTED):
    seen = edit(perfect(ELSEWHERE, stage))
    verdict = verify(ELSEWHERE, seen, stage=stage, machines=machines)
    return [(each.rule, each.expected) for each in verdict.findings]


@pytest.mark.parametrize("edit", [unchanged, ACTIVE])
def test_before_our_gate_a_node_of_another_machine_may_be_inactive_or_active(edit: Edit):
    assert rules_with(frozenset({"m1"}), edit) == []


@pytest.mark.parametrize("machines", [None, frozenset({"m1", "m2"})])
def test_before_our_gate_a_node_that_we_bring_up_must_not_be_active(machines):
    assert rules_with(machines, ACTIVE) == [("state.wrong-state", "inactive, connected")]


def test_a_node_of_another_machine_must_be_connected_all_the_same():
    edit = change_configuration("/two", connected=False)
    assert rules_with(frozenset({"m1"}), edit) == [
        ("state.wrong-state", "inactive, connected or active")
    ]


def test_after_our_gate_every_node_must_be_active_wherever_it_is():
    edit = both(
        change_node("/two", state="inactive"), change_configuration("/two", state="inactive")
    )
    assert rules_with(frozenset({"m1"}), edit, Stage.ACTIVE) == [("state.wrong-state", "active")]
