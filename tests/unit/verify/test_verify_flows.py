"""What flow reports say of how a flow runs."""

from __future__ import annotations

import pytest

from lifecycle.manifest.model import EndpointKind, UniqueHow
from lifecycle.network.nfe import UniqueRequirement
from lifecycle.plan import Plan, build_plan
from lifecycle.verify import FlowReport, Outcome, Stage, verify
from tests.unit.plan.samples import link, need, node, planned, publisher, subscription, teleop
from tests.unit.verify.edits import (
    Edit,
    both,
    change_report,
    drop_endpoint,
    drop_node,
    drop_report,
)
from tests.unit.verify.perfect import perfect

PUB, SUB = EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION
PLAN = build_plan(teleop(), environment={})


def flows_after(edit: Edit, plan: Plan = PLAN) -> tuple[FlowReport, ...]:
    return verify(plan, edit(perfect(plan)), stage=Stage.CONNECTED).flows


def unchanged(seen):
    return seen


def test_every_planned_flow_is_reported_with_both_ends_and_its_requirement():
    video, battery, status = flows_after(unchanged)
    strictly, none = UniqueRequirement.STRICTLY_REQUIRED, UniqueRequirement.NOT_REQUIRED
    assert (video.topic, video.publisher, video.subscription) == (
        "/robot/video",
        "/robot/camera",
        "/viewer",
    )
    assert (video.unique, video.demanded) == (UniqueHow.STRONGLY, UniqueHow.STRONGLY)
    assert (video.requirement, battery.requirement) == ((strictly, strictly), (none, none))
    assert (video.dscp, battery.dscp, status.dscp) == (46, 8, None)
    assert (video.max_delay_ms, battery.max_delay_ms) == (5.0, None)
    assert [each.dscp for each in video.source] == [46, 46]
    assert video.destination[1].transport_port == 7020


@pytest.mark.parametrize(
    ("machines", "transport"), [(("m", "m"), "shm or udp"), (("m", "n"), "udp")]
)
def test_shared_memory_can_carry_a_flow_only_on_one_machine(machines, transport):
    one, other = machines
    plan = planned(
        node("one", publisher("a"), machine=one), node("two", subscription("a"), machine=other)
    )
    (flow,) = flows_after(unchanged, plan)
    assert flow.transport == transport


def test_a_flow_of_unknown_nfes_tells_neither_transport_nor_uniqueness():
    flow = flows_after(drop_report("/robot/camera"))[2]
    assert (flow.source, flow.unique, flow.transport) == ((), None, "unknown")


@pytest.mark.parametrize(
    ("edit", "outcomes"),
    [
        (drop_node("/viewer"), [Outcome.VIOLATED] * 3),
        (
            drop_endpoint(SUB, "/robot/battery"),
            [Outcome.OK, Outcome.VIOLATED, Outcome.OK],
        ),
        (
            change_report(PUB, "/robot/video", nfes=None),
            [Outcome.UNVERIFIABLE, Outcome.OK, Outcome.OK],
        ),
        (
            both(
                change_report(PUB, "/robot/status", matched=0),
                change_report(SUB, "/robot/status", matched=0),
            ),
            [Outcome.OK, Outcome.OK, Outcome.VIOLATED],
        ),
        (
            change_report(PUB, "/robot/battery", dscp=0),
            [Outcome.OK, Outcome.VIOLATED, Outcome.OK],
        ),
    ],
)
def test_a_flow_has_the_worst_outcome_of_what_concerns_it(edit, outcomes):
    assert [each.outcome for each in flows_after(edit)] == outcomes


@pytest.mark.parametrize(
    ("demanded", "unique_ends", "outcome"),
    [
        (UniqueHow.WEAKLY, (PUB,), Outcome.OK),
        (UniqueHow.WEAKLY, (SUB,), Outcome.OK),
        (UniqueHow.WEAKLY, (), Outcome.VIOLATED),
        (UniqueHow.STRONGLY, (PUB, SUB), Outcome.OK),
        (UniqueHow.STRONGLY, (PUB,), Outcome.VIOLATED),
        (UniqueHow.NOT, (), Outcome.OK),
    ],
)
def test_a_link_demands_weakly_or_strongly_unique_flows(demanded, unique_ends, outcome):
    optional = UniqueRequirement.OPTIONALLY_REQUIRED
    plan = planned(
        node(
            "one",
            publisher("a"),
            publisher("b"),
            needs=[need(PUB, "a", optional)] if PUB in unique_ends else [],
        ),
        node(
            "two",
            subscription("a"),
            subscription("b"),
            needs=[need(SUB, "a", optional)] if SUB in unique_ends else [],
        ),
        links=[link("/a", "one", "two", unique=demanded)],
    )
    verdict = verify(plan, perfect(plan), stage=Stage.CONNECTED)
    assert verdict.flows[0].outcome is outcome
    assert [each.rule for each in verdict.findings] == (
        [] if outcome is Outcome.OK else ["flow.not-unique"]
    )


def test_an_unmet_link_says_which_end_is_not_unique():
    plan = planned(
        node("one", publisher("a"), publisher("b")),
        node("two", subscription("a")),
        links=[link("/a", "one", "two", unique=UniqueHow.STRONGLY)],
    )
    (finding,) = verify(plan, perfect(plan), stage=Stage.CONNECTED).findings
    assert finding.message == (
        "cannot accept the flow /one → /two on /a: its link demands a strongly unique flow;"
        " publisher not unique, subscription unique"
    )


def test_a_link_between_nodes_that_declare_no_such_endpoints_is_unmatched():
    plan = planned(node("one"), node("two"), links=[link("/a", "one", "two")])
    (finding,) = verify(plan, perfect(plan), stage=Stage.CONNECTED).findings
    assert (finding.rule, finding.observed) == (
        "graph.unmatched-link",
        "/one declares no publisher of it",
    )
