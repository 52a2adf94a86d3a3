"""What flow reports say of how a flow runs."""

from __future__ import annotations

import pytest

from lifecycle.manifest.model import EndpointKind, Quantity, Run, RunKind, UniqueHow
from lifecycle.network.nfe import UniqueRequirement
from lifecycle.plan.build import build_plan
from lifecycle.plan.model import Plan
from lifecycle.verify.observation import Observation
from lifecycle.verify.outcome import ConnectionReport, Outcome
from lifecycle.verify.verdict import Finding, FlowReport, Stage
from tests.builders import (
    at,
    link,
    need,
    nfe,
    node,
    planned,
    publisher,
    shared_memory,
    subscription,
    teleop,
)
from tests.unit.verify.edits import (
    Edit,
    both,
    change_configuration,
    change_report,
    drop_endpoint,
    drop_endpoint_report,
    drop_report,
    unchanged,
)
from tests.unit.verify.lines import lines, verify
from tests.unit.verify.perfect import perfect

PUB, SUB = EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION
FOREIGN = Run(kind=RunKind.COMMAND, command=("other",))
PLAN = build_plan(teleop(), environment={})


def flows_after(edit: Edit, plan: Plan = PLAN) -> tuple[FlowReport, ...]:
    return verify(plan, edit(perfect(plan)), stage=Stage.CONNECTED).flows


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


def test_the_dscp_of_a_flow_is_what_was_read_and_not_what_was_planned():
    video, battery, _ = flows_after(
        both(
            change_report(PUB, "/robot/video", dscp=0),
            change_report(PUB, "/robot/battery", dscp=None),
        )
    )
    assert (video.dscp, battery.dscp) == (0, None)
    assert {each.dscp for each in video.source} == {0}


MARKED_READER = planned(
    node("one", publisher("a"), needs=[need(PUB, "a", dscp=46)]),
    node("two", subscription("a"), needs=[need(SUB, "a", dscp=48)]),
)


def test_what_a_subscription_acknowledges_with_is_shown_beside_what_the_data_carry():
    (flow,) = flows_after(unchanged, MARKED_READER)
    assert (flow.dscp, flow.reader_dscp) == (46, 48)
    assert {each.dscp for each in flow.source} == {46}
    assert {each.dscp for each in flow.destination} == {0}, "data do not carry it"
    (flow,) = flows_after(change_report(SUB, "/a", dscp=0), MARKED_READER)
    assert (flow.dscp, flow.reader_dscp, flow.outcome) == (46, 0, Outcome.VIOLATED)


@pytest.mark.parametrize(
    ("read", "rule"), [(0, "flow.dscp-not-applied"), (None, "flow.dscp-unverifiable")]
)
def test_the_mark_of_a_subscription_is_judged_like_that_of_a_publisher(read, rule):
    seen = change_report(SUB, "/a", dscp=read)(perfect(MARKED_READER))
    (found,) = verify(MARKED_READER, seen, stage=Stage.CONNECTED).findings
    assert (found.rule, found.node, found.endpoint) == (rule, "/two", SUB)
    assert "the subscription of /a in /two" in found.message


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


# --- what findings on flows say

STRICTLY = UniqueRequirement.STRICTLY_REQUIRED


def of_flows(edit: Edit, plan: Plan) -> list[Finding]:
    """The findings of the rules on flows."""
    verdict = verify(plan, edit(perfect(plan)), stage=Stage.CONNECTED)
    return [each for each in verdict.findings if each.rule.startswith("flow.")]


def strict(*, linked: UniqueHow | None = None) -> Plan:
    """A publisher that strictly requires a unique flow, another one, and a subscription."""
    return planned(
        node(
            "one",
            publisher("a", line=11),
            publisher("b", line=12),
            needs=[need(PUB, "a", STRICTLY)],
        ),
        node("two", subscription("a", line=13)),
        links=[link("/a", "one", "two", unique=linked)] if linked else [],
    )


def carried(node: str, topic: str) -> Edit:
    """The node reports the participant of a publisher by itself, not only with the publisher."""

    def edit(seen: Observation) -> Observation:
        gid = next(each.gid for each in seen.endpoints if (each.kind, each.name) == (PUB, topic))
        own = ConnectionReport(name="", node_name="_one_flow_0", prefix=gid[:24])
        return change_configuration(node, connections=(own,))(seen)

    return edit


SHARED = both(
    change_report(
        PUB,
        "/a",
        nfes=(
            shared_memory(1),
            nfe("0.0.0.0", 40000),
            nfe("0.0.0.0", 40000),
            nfe("fd00::1", 40001),
        ),
    ),
    change_report(PUB, "/b", nfes=(shared_memory(1), nfe("0.0.0.0", 40000))),
)


def marked(*, enforce: bool = True) -> Plan:
    return planned(
        node(
            "one",
            publisher("a"),
            publisher("b"),
            needs=[need(PUB, name, dscp=46, enforce=enforce) for name in ("a", "b")],
        )
    )


def unlinked_ends(how: UniqueHow) -> Plan:
    """Ends that share their flows, and a link that demands one of its own."""
    return planned(
        node("one", publisher("a"), publisher("b")),
        node("two", subscription("a"), subscription("b")),
        links=[link("/a", "one", "two", unique=how)],
    )


SAYS: dict[str, tuple[Edit, Plan, list[str]]] = {
    "a strict endpoint shares its flow": (
        SHARED,
        strict(),
        ["violated flow.not-unique: /a, /one (publisher) at 11:9"],
    ),
    "the RMW of a strict endpoint reports no network flow endpoints": (
        change_report(PUB, "/a", nfes=None),
        strict(),
        ["violated flow.unverifiable: /a, /one (publisher) at 11:9"],
    ),
    "an endpoint beside a strict one reports none": (
        change_report(PUB, "/b", nfes=None),
        strict(),
        ["violated flow.unverifiable: /a, /one (publisher) at 11:9"],
    ),
    "the node of a strict endpoint reports it by its participant alone": (
        both(carried("/one", "/a"), drop_endpoint_report(PUB, "/a")),
        strict(),
        ["violated flow.unverifiable: /a, /one (publisher) at 11:9"],
    ),
    "a link that demands a weakly unique flow has none": (
        unchanged,
        unlinked_ends(UniqueHow.WEAKLY),
        ["violated flow.not-unique: /a: /one → /two, no node at 10:9"],
    ),
    "a link that demands a strongly unique flow has none": (
        unchanged,
        unlinked_ends(UniqueHow.STRONGLY),
        ["violated flow.not-unique: /a: /one → /two, no node at 10:9"],
    ),
    "the demand of a link cannot be proven": (
        change_report(SUB, "/a", nfes=None),
        strict(linked=UniqueHow.STRONGLY),
        ["violated flow.unverifiable: /a: /one → /two, no node at 13:9"],
    ),
    "sockets carry another DSCP": (
        change_report(PUB, "/a", dscp=8),
        marked(),
        ["violated flow.dscp-not-applied: /a, /one (publisher) at 10:9"],
    ),
    "sockets carry another DSCP, which is not enforced": (
        change_report(PUB, "/a", dscp=8),
        marked(enforce=False),
        ["unverifiable flow.dscp-not-applied: /a, /one (publisher) at 10:9"],
    ),
    "nobody read a DSCP back": (
        change_report(PUB, "/a", dscp=None),
        marked(),
        ["unverifiable flow.dscp-unverifiable: /a, /one (publisher) at 10:9"],
    ),
    "a DSCP is that of a participant alone": (
        both(carried("/one", "/a"), drop_endpoint_report(PUB, "/a")),
        marked(),
        ["unverifiable flow.dscp-unverifiable: /a, /one (publisher) at 10:9"],
    ),
}


@pytest.mark.parametrize("case", SAYS)
def test_what_is_found_of_a_flow_where(case: str):
    edit, plan, text = SAYS[case]
    assert lines(of_flows(edit, plan)) == text


@pytest.mark.parametrize(
    "edit",
    [
        change_report(PUB, "/a", error="refused", nfes=None),
        change_report(PUB, "/a", error="refused", nfes=(nfe("0.0.0.0", 40000),)),
        both(drop_endpoint(PUB, "/a"), drop_report("/one")),
    ],
)
def test_a_strict_endpoint_that_was_not_made_is_not_named_besides(edit: Edit):
    assert of_flows(edit, strict()) == []


# --- links


@pytest.mark.parametrize(
    ("publishers", "subscriptions", "edit"),
    [
        (("a",), ("a",), both(drop_endpoint(PUB, "/a"), drop_report("/one"))),
        (("a",), ("a",), both(drop_endpoint(SUB, "/a"), drop_report("/two"))),
        ((), ("a",), unchanged),
        (("a",), (), unchanged),
        ((), (), unchanged),
    ],
)
def test_the_demand_of_a_link_of_which_an_end_is_not_there_or_not_declared_is_not_named_besides(
    publishers: tuple[str, ...], subscriptions: tuple[str, ...], edit: Edit
):
    plan = planned(
        node("one", *map(publisher, publishers)),
        node("two", *map(subscription, subscriptions)),
        links=[link("/a", "one", "two", unique=UniqueHow.STRONGLY)],
    )
    assert of_flows(edit, plan) == []


# --- numbers


@pytest.mark.parametrize(
    ("edit", "named"),
    [
        (unchanged, ["/a", "/b", "/a: /one → /two", "/b: /one → /two"]),
        (both(drop_endpoint(PUB, "/a"), drop_report("/one")), ["/b", "/b: /one → /two"]),
        (drop_endpoint(SUB, "/a"), ["/a", "/b", "/b: /one → /two"]),
        (drop_report("/one"), ["/a", "/b", "/a: /one → /two", "/b: /one → /two"]),
    ],
)
def test_numbers_are_named_of_what_is_there_and_of_nothing_else(edit, named):
    rate = (Quantity(name="rate_hz", value=5, at=at(22)),)
    plan = planned(
        node(
            "one",
            publisher("a"),
            publisher("b"),
            needs=[need(PUB, name, quantities=rate) for name in ("a", "b")],
        ),
        node("two", subscription("a"), subscription("b"), run=FOREIGN),
        links=[link(topic, "one", "two", quantities=rate) for topic in ("/a", "/b")],
    )
    found = [each for each in of_flows(edit, plan) if each.rule == "flow.not-measured"]
    assert [each.subject for each in found] == named


# --- DSCP
