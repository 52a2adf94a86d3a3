"""What a flow report takes from findings and sockets."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import EndpointKind, Machine, UniqueHow
from lifecycle.network.nfe import (
    InternetProtocol,
    NetworkFlowEndpoint,
    TransportProtocol,
    UniqueRequirement,
)
from lifecycle.plan.build import build_plan
from lifecycle.plan.model import Plan
from lifecycle.verify.judge import flow_reports
from lifecycle.verify.matcher import lay_out
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import Finding, FlowReport, Stage
from tests.builders import at, node, planned, publisher, subscription, teleop
from tests.unit.verify.edits import Edit, both, change_report, drop_report
from tests.unit.verify.lines import verify
from tests.unit.verify.perfect import perfect

PUB, SUB = EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION
PLAN = build_plan(teleop(), environment={})


def flows_after(edit: Edit, plan: Plan = PLAN) -> tuple[FlowReport, ...]:
    return verify(plan, edit(perfect(plan)), stage=Stage.CONNECTED).flows


NET = planned(
    node("one", publisher("a"), machine="m"),
    node("two", subscription("a"), machine="n"),
)


def finding(
    subject: str,
    node: str = "",
    endpoint: EndpointKind | None = None,
    *,
    outcome: Outcome = Outcome.UNVERIFIABLE,
    rule: str = "graph.qos-incompatible",
) -> Finding:
    return Finding(
        rule=rule,
        outcome=outcome,
        subject=subject,
        expected="",
        observed="",
        message="",
        node=node,
        endpoint=endpoint,
    )


def outcome_with(*findings: Finding) -> Outcome:
    (flow,) = flow_reports(lay_out(NET, perfect(NET), Stage.CONNECTED), findings)
    return flow.outcome


SUBJECT = "/a: /one → /two"


@pytest.mark.parametrize(
    ("place", "concerns"),
    [
        ((SUBJECT, "", None), True),
        (("/one", "/one", None), True),
        (("/two", "/two", None), True),
        (("/a", "/one", PUB), True),
        (("/a", "/two", SUB), True),
        (("/a", "/one", SUB), False),
        (("/a", "/two", PUB), False),
        (("/a", "", None), False),
        (("/b", "/one", PUB), False),
        (("/three", "/three", None), False),
        ((SUBJECT, "/one", None), False),
    ],
)
def test_a_finding_concerns_a_flow_at_its_pair_its_nodes_and_its_endpoints(place, concerns):
    expected = Outcome.UNVERIFIABLE if concerns else Outcome.OK
    assert outcome_with(finding(*place)) is expected
    assert outcome_with(finding(*place, rule="graph.qos-differs")) is Outcome.OK


def nfe(protocol: str, family: str = "ipv4", address: str = "10.0.0.1") -> NetworkFlowEndpoint:
    return NetworkFlowEndpoint(
        transport_protocol=TransportProtocol(protocol),
        internet_protocol=InternetProtocol(family),
        transport_port=7000,
        internet_address=address,
    )


UDP4, UDP6 = nfe("udp"), nfe("udp", "ipv6", "fd00::1")
TCP4, TCP6 = nfe("tcp"), nfe("tcp", "ipv6", "fd00::1")


def flow_between(source, destination) -> FlowReport:
    (flow,) = flows_after(
        both(
            change_report(PUB, "/a", nfes=source, dscp=46),
            change_report(SUB, "/a", nfes=destination, dscp=46),
        ),
        NET,
    )
    return flow


@pytest.mark.parametrize(
    ("carried_by", "source", "destination", "used", "dscp"),
    [
        ("tcpv4", (TCP4, UDP6), (TCP4, UDP4), ((TCP4,), (TCP4,)), None),
        ("tcpv6", (TCP6, UDP4), (TCP6, UDP6), ((TCP6,), (TCP6,)), None),
        ("udpv4", (TCP4, UDP4), (TCP6, UDP4), ((UDP4,), (UDP4,)), 46),
        ("udpv6", (TCP4, UDP6), (TCP6, UDP6), ((UDP6,), (UDP6,)), 46),
        ("none", (TCP4, UDP4), (UDP6,), ((TCP4, UDP4), (UDP6,)), 46),
    ],
)
def test_only_sockets_of_what_carries_a_flow_are_shown(carried_by, source, destination, used, dscp):
    flow = flow_between(source, destination)
    assert flow.effective_transport == carried_by
    assert (
        tuple(
            tuple(replace(each, dscp=0) for each in end) for end in (flow.source, flow.destination)
        )
        == used
    )
    assert (flow.dscp, flow.reader_dscp) == (dscp, dscp)


@pytest.mark.parametrize(
    ("address", "unique"), [("10.0.0.1", UniqueHow.STRONGLY), ("", UniqueHow.WEAKLY)]
)
def test_a_flow_is_as_unique_as_it_is_on_the_declared_address_of_its_machine(address, unique):
    plan = planned(
        node("one", publisher("a"), publisher("b"), machine="m"),
        node("two", subscription("a"), machine="n"),
        machines=(
            Machine(name="m", address=address, at=at(2)),
            Machine(name="n", address="10.0.0.2", at=at(2)),
        ),
    )
    here, remote_nodes = nfe("udp"), nfe("udp", address="10.9.9.9")
    flow, *_ = flows_after(
        both(
            change_report(PUB, "/a", nfes=(here, remote_nodes)),
            change_report(PUB, "/b", nfes=(remote_nodes,)),
        ),
        plan,
    )
    assert flow.unique is unique


def test_a_report_has_what_the_manifest_asks_of_the_flow():
    (one, two), (flow,) = NET.nodes, NET.flows
    (end,) = one.endpoints
    asks = replace(end, five_qi=85, five_qi_reason="why", unique=UniqueRequirement.SYSTEM_DEFAULT)
    plan = replace(
        NET,
        nodes=(replace(one, endpoints=(asks,)), two),
        flows=(replace(flow, unique=UniqueHow.WEAKLY, max_delay_ms=5.0),),
    )
    (found,) = flow_reports(lay_out(plan, perfect(plan), Stage.CONNECTED), ())
    assert found.pair == ("/a", "/one", "/two")
    assert (found.five_qi, found.five_qi_reason) == (85, "why")
    assert (found.max_delay_ms, found.demanded) == (5.0, UniqueHow.WEAKLY)
    assert [each.value for each in found.requirement] == ["system_default", "not_required"]


def test_of_ends_that_report_nothing_no_dscp_is_shown():
    plan = planned(node("one", publisher("a")), node("two", subscription("a")))
    (flow,) = flows_after(both(drop_report("/one"), drop_report("/two")), plan)
    assert (flow.dscp, flow.reader_dscp, flow.unique) == (None, None, None)
