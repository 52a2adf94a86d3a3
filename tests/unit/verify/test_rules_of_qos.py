"""QoS that is written against QoS that is there, and what is offered against what is requested."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import EndpointKind, EndpointPolicy, Policy, Run, RunKind
from lifecycle.manifest.qos import (
    BEST_AVAILABLE_NS,
    INFINITE_NS,
    Durability,
    History,
    Liveliness,
    QosProfile,
    Reliability,
)
from lifecycle.plan.model import Plan
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import Finding, Stage
from tests.builders import node, planned, publisher, subscription
from tests.unit.verify.edits import (
    Edit,
    add_endpoint,
    add_node,
    both,
    change_announced_qos,
    change_endpoint,
)
from tests.unit.verify.lines import verify
from tests.unit.verify.perfect import perfect

PUB, SUB = EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION
ATTACH = Run(kind=RunKind.ATTACH)
BEST_EFFORT = QosProfile(reliability=Reliability.BEST_EFFORT)
NS = 10**9


def pair(offered: QosProfile, requested: QosProfile = BEST_EFFORT, **rest: object) -> Plan:
    """A publisher and a subscription of a topic, in two nodes that tell nothing of themselves."""
    return planned(
        node("one", publisher("a", qos=offered, line=11), run=ATTACH, managed=False),
        node("two", subscription("a", qos=requested, line=12), run=ATTACH, managed=False),
        **rest,
    )


def findings(edit: Edit, plan: Plan) -> tuple[Finding, ...]:
    found = verify(plan, edit(perfect(plan)), stage=Stage.CONNECTED).findings
    return tuple(each for each in found if each.rule != "flow.unreported")


def of(rule: str, edit: Edit, plan: Plan) -> list[Finding]:
    return [each for each in findings(edit, plan) if each.rule == rule]


def differing(edit: Edit, plan: Plan) -> list[str]:
    """Which policies differ from the declared ones, and from what to what."""
    return [
        f"{each.endpoint.noun}: {each.expected}, {each.observed}"
        for each in of("graph.qos-differs", edit, plan)
        if each.endpoint
    ]


# --- declared against actual


@pytest.mark.parametrize(
    ("policies", "found"),
    [
        ({"history": History.KEEP_ALL}, "history KEEP_LAST, history KEEP_ALL"),
        ({"depth": 4}, "depth 10, depth 4"),
        (
            {"reliability": Reliability.BEST_EFFORT},
            "reliability RELIABLE, reliability BEST_EFFORT",
        ),
        (
            {"durability": Durability.TRANSIENT_LOCAL},
            "durability VOLATILE, durability TRANSIENT_LOCAL",
        ),
        ({"lifespan_ns": 3}, "lifespan_ns infinite, lifespan_ns 3 ns"),
        (
            {"liveliness": Liveliness.MANUAL_BY_TOPIC},
            "liveliness AUTOMATIC, liveliness MANUAL_BY_TOPIC",
        ),
        (
            {"liveliness_lease_duration_ns": 3},
            "liveliness_lease_duration_ns infinite, liveliness_lease_duration_ns 3 ns",
        ),
    ],
)
def test_every_policy_that_is_written_is_compared(policies: dict[str, object], found: str):
    edit = change_announced_qos(PUB, "/a", **policies)
    assert differing(edit, pair(QosProfile())) == [f"publisher: {found}"]


@pytest.mark.parametrize("never", [None, 0, INFINITE_NS])
def test_every_form_of_infinite_is_one(never: int | None):
    plan = pair(QosProfile(deadline_ns=NS))
    edit = change_announced_qos(PUB, "/a", deadline_ns=never)
    assert differing(edit, plan) == ["publisher: deadline_ns 1000000000 ns, deadline_ns infinite"]
    assert differing(edit, pair(QosProfile(deadline_ns=0))) == []


def test_a_lifespan_is_compared_at_the_publisher_alone():
    edit = both(
        change_announced_qos(PUB, "/a", lifespan_ns=7),
        change_announced_qos(SUB, "/a", lifespan_ns=7, depth=3),
    )
    assert differing(edit, pair(QosProfile())) == [
        "publisher: lifespan_ns infinite, lifespan_ns 7 ns",
        "subscription: depth 10, depth 3",
    ]


def test_a_depth_means_something_only_where_the_last_messages_are_kept():
    plan = pair(QosProfile(history=History.KEEP_ALL))
    assert differing(change_announced_qos(PUB, "/a", depth=3, deadline_ns=5), plan) == [
        "publisher: deadline_ns infinite, deadline_ns 5 ns"
    ]


SYSTEM = QosProfile(
    history=History.SYSTEM_DEFAULT,
    depth=0,
    reliability=Reliability.SYSTEM_DEFAULT,
    durability=Durability.SYSTEM_DEFAULT,
    liveliness=Liveliness.SYSTEM_DEFAULT,
)
OTHERWISE = change_announced_qos(
    PUB, "/a", deadline_ns=5, durability=Durability.TRANSIENT_LOCAL, lifespan_ns=6
)


def test_rmws_system_default_leaves_the_durations_to_the_middleware_too():
    assert differing(OTHERWISE, pair(SYSTEM)) == []


@pytest.mark.parametrize(
    ("written", "found"),
    [
        ({"deadline_ns": 9}, ["deadline_ns 9 ns, deadline_ns 5 ns"]),
        ({"lifespan_ns": 9}, ["deadline_ns infinite, deadline_ns 5 ns"]),
        ({"liveliness_lease_duration_ns": 9}, ["deadline_ns infinite, deadline_ns 5 ns"]),
        ({"history": History.KEEP_ALL}, ["deadline_ns infinite, deadline_ns 5 ns"]),
        ({"reliability": Reliability.RELIABLE}, ["deadline_ns infinite, deadline_ns 5 ns"]),
        ({"liveliness": Liveliness.AUTOMATIC}, ["deadline_ns infinite, deadline_ns 5 ns"]),
        (
            {"durability": Durability.VOLATILE},
            [
                "durability VOLATILE, durability TRANSIENT_LOCAL",
                "deadline_ns infinite, deadline_ns 5 ns",
            ],
        ),
    ],
)
def test_a_profile_that_writes_one_policy_beside_defaults_is_compared(
    written: dict[str, object], found: list[str]
):
    plan = pair(replace(SYSTEM, **written))
    lifespan = f"lifespan_ns {written.get('lifespan_ns', 'infinite')}"
    lifespan += " ns" if "lifespan_ns" in written else ""
    assert differing(OTHERWISE, plan) == [
        f"publisher: {each}" for each in (*found, f"{lifespan}, lifespan_ns 6 ns")
    ]


def test_values_that_leave_the_choice_to_the_middleware_are_not_compared():
    free = QosProfile(
        reliability=Reliability.BEST_AVAILABLE,
        durability=Durability.UNKNOWN,
        liveliness=Liveliness.BEST_AVAILABLE,
        deadline_ns=BEST_AVAILABLE_NS,
        liveliness_lease_duration_ns=BEST_AVAILABLE_NS,
    )
    edit = change_announced_qos(
        PUB,
        "/a",
        reliability=Reliability.BEST_EFFORT,
        durability=Durability.TRANSIENT_LOCAL,
        liveliness=Liveliness.MANUAL_BY_TOPIC,
        deadline_ns=1,
        liveliness_lease_duration_ns=2,
        lifespan_ns=3,
    )
    assert differing(edit, pair(free)) == ["publisher: lifespan_ns infinite, lifespan_ns 3 ns"]


# --- what is not known


def test_of_an_endpoint_whose_qos_nobody_knows_every_written_policy_is_unverifiable():
    found = of("graph.qos-unverifiable", change_endpoint(SUB, "/a", qos=None), pair(QosProfile()))
    assert [each.expected for each in found] == [
        (
            "/a (subscription): history KEEP_LAST, depth 10, reliability BEST_EFFORT, durability"
            " VOLATILE, deadline_ns infinite, liveliness AUTOMATIC, liveliness_lease_duration_ns"
            " infinite"
        )
    ]


# --- offered against requested


def incompatible(edit: Edit, plan: Plan) -> list[tuple[str, str, str]]:
    return [
        (each.subject, each.expected, each.observed)
        for each in of("graph.qos-incompatible", edit, plan)
    ]


LESS = change_announced_qos(PUB, "/a", reliability=Reliability.BEST_EFFORT)


def open_world(*endpoints: object) -> Plan:
    return planned(
        node("one", *endpoints, run=ATTACH, managed=False, endpoints=EndpointPolicy.OPEN),
        policy=Policy(undeclared_nodes=EndpointPolicy.OPEN),
    )


@pytest.mark.parametrize(
    ("declared", "offers", "requests", "subject", "at"),
    [
        ((publisher("a"),), "/one", "/other", "/a: /one → /other", "robot.lifecycle.yaml:10:9"),
        ((subscription("a"),), "/other", "/one", "/a: /other → /one", "robot.lifecycle.yaml:10:9"),
        ((), "/one", "/other", "/a: /one → /other", ""),
        ((), "/other", "/one", "/a: /other → /one", ""),
        ((), "/one", "", "/a: /one → an unknown node", ""),
        ((), "", "/one", "/a: an unknown node → /one", ""),
        ((), "/other", "/another", "", ""),
    ],
)
def test_a_pair_is_judged_where_one_end_at_least_is_of_a_declared_node(
    declared, offers, requests, subject, at
):
    plan = open_world(*declared)
    kinds = {each.kind for each in declared}
    ends: list[Edit] = [add_node("/other"), add_node("/another")]
    if PUB not in kinds or offers != "/one":
        ends.append(add_endpoint(PUB, offers, "/a", gid="98", qos=BEST_EFFORT))
    if SUB not in kinds or requests != "/one":
        ends.append(add_endpoint(SUB, requests, "/a", gid="99", qos=QosProfile()))
    if PUB in kinds and offers == "/one":
        ends.append(LESS)
    found = of("graph.qos-incompatible", both(*ends), plan)
    assert [(each.subject, each.at) for each in found] == ([(subject, at)] if subject else [])


def test_an_end_whose_qos_nobody_knows_may_match_anything():
    plan = pair(QosProfile(), QosProfile())
    for kind in (PUB, SUB):
        found = of("graph.qos-incompatible", change_endpoint(kind, "/a", qos=None), plan)
        assert {each.outcome for each in found} <= {Outcome.UNVERIFIABLE}
    edit = change_endpoint(PUB, "/a", qos=None)
    assert [each[1:] for each in incompatible(edit, plan)] == [
        ("reliability RELIABLE", "reliability UNKNOWN")
    ]


def test_what_is_equal_of_other_topics_or_nodes_is_a_finding_of_its_own():
    plan = planned(
        node("one", publisher("a"), publisher("b"), run=ATTACH, managed=False),
        node("two", subscription("a"), subscription("b"), run=ATTACH, managed=False),
        node("three", publisher("a"), subscription("b"), run=ATTACH, managed=False),
    )
    edit = both(LESS, change_announced_qos(PUB, "/b", reliability=Reliability.BEST_EFFORT))
    assert [each[0] for each in incompatible(edit, plan)] == [
        "/a: /one → /two",
        "/a: /three → /two",
        "/b: /one → /two",
        "/b: /one → /three",
    ]
