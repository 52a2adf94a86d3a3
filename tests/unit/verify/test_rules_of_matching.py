"""Which declared pairs are matched, by what either end says of the other."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import EndpointKind, EndpointPolicy, Policy
from lifecycle.manifest.qos import QosProfile, Reliability
from lifecycle.plan.model import Plan
from lifecycle.verify.observation import Observation
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import Finding, Stage
from tests.builders import BEST_EFFORT, link, node, planned, publisher, subscription
from tests.unit.verify.edits import (
    Edit,
    add_endpoint,
    both,
    change_announced_qos,
    change_endpoint,
    change_report,
    drop_endpoint,
    unchanged,
)
from tests.unit.verify.lines import verify
from tests.unit.verify.perfect import perfect

PUB, SUB = EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION
INT = "std_msgs/msg/Int32"
OPEN = Policy(undeclared_nodes=EndpointPolicy.OPEN)


def pair(qos: QosProfile = QosProfile(), *, linked: bool = False) -> Plan:  # noqa: B008
    return planned(
        node("one", publisher("a", qos=qos, line=11)),
        node("two", subscription("a", qos=qos, line=12)),
        links=[link("/a", "one", "two")] if linked else [],
        policy=OPEN,
    )


def matching(edit: Edit, plan: Plan) -> list[Finding]:
    """The findings of these two rules alone."""
    verdict = verify(plan, edit(perfect(plan)), stage=Stage.CONNECTED)
    return [each for each in verdict.findings if each.rule.startswith("graph.unmatched-")]


def said(edit: Edit, plan: Plan) -> list[tuple[str, str]]:
    return [(each.outcome.value, each.observed) for each in matching(edit, plan)]


def silent(kind: EndpointKind) -> Edit:
    """One end says nothing of its matches."""
    return change_report(kind, "/a", matched=None)


# --- why a link cannot be matched at all

TYPES = change_endpoint(PUB, "/a", type=INT)
LESS = change_announced_qos(PUB, "/a", reliability=Reliability.BEST_EFFORT)


@pytest.mark.parametrize(
    ("edit", "cause"),
    [
        (drop_endpoint(PUB, "/a"), "the publisher is missing"),
        (drop_endpoint(SUB, "/a"), "the subscription is missing"),
        (TYPES, f"the types differ, {INT} and std_msgs/msg/String"),
        (LESS, "the QoS is incompatible"),
    ],
)
def test_a_link_names_why_its_ends_cannot_match_and_a_flow_leaves_it_to_that_finding(
    edit: Edit, cause: str
):
    assert said(edit, pair(linked=True)) == [("violated", cause)]
    assert said(edit, pair()) == []


@pytest.mark.parametrize(
    ("endpoints", "cause"),
    [
        (((), (subscription("a"),)), "/one declares no publisher of it"),
        (((publisher("a"),), ()), "/two declares no subscription of it"),
    ],
)
def test_a_link_that_names_a_node_without_such_an_endpoint_is_violated(endpoints, cause):
    one, two = endpoints
    plan = planned(node("one", *one), node("two", *two), links=[link("/a", "one", "two")])
    assert said(unchanged, plan) == [("violated", cause)]


def test_types_and_qos_are_those_that_are_there_and_not_those_declared():
    plan = pair(BEST_EFFORT, linked=True)
    edit = change_announced_qos(SUB, "/a", reliability=Reliability.RELIABLE)
    assert said(edit, plan) == [("violated", "the QoS is incompatible")]
    both_otherwise = both(TYPES, change_endpoint(SUB, "/a", type=INT))
    assert said(both_otherwise, pair(linked=True)) == []


@pytest.mark.parametrize("kind", [PUB, SUB])
def test_a_policy_that_discovery_does_not_know_is_that_of_the_nodes_report(kind: EndpointKind):
    other = SUB if kind is PUB else PUB
    hides = change_announced_qos(kind, "/a", reliability=Reliability.UNKNOWN)
    reports = change_report(kind, "/a", qos=QosProfile(reliability=Reliability.BEST_EFFORT))
    needs = change_announced_qos(other, "/a", reliability=Reliability.RELIABLE)
    expected = [("violated", "the QoS is incompatible")] if kind is PUB else []
    assert said(both(hides, reports, needs), pair(linked=True)) == expected
    assert said(both(hides, needs), pair(linked=True)) == []


# --- what either end says


@pytest.mark.parametrize(("kind", "word"), [(PUB, "publisher"), (SUB, "subscription")])
@pytest.mark.parametrize("other_says", ["nothing", "matched"])
def test_one_end_that_matched_nobody_is_enough(kind, word, other_says):
    edits = [change_report(kind, "/a", matched=0)]
    if other_says == "nothing":
        edits.append(silent(SUB if kind is PUB else PUB))
    assert said(both(*edits), pair()) == [("violated", f"the {word} matched none")]


@pytest.mark.parametrize("kind", [PUB, SUB])
def test_one_end_that_names_the_other_is_enough_where_the_other_says_nothing(kind: EndpointKind):
    for linked in (False, True):
        assert said(silent(kind), pair(linked=linked)) == []


def test_where_neither_end_says_anything_a_flow_goes_by_discovery_and_a_link_does_not():
    edit = both(silent(PUB), silent(SUB))
    assert said(edit, pair()) == []
    assert said(edit, pair(linked=True)) == [
        ("unverifiable", "neither end reports whom it is matched with")
    ]


# --- ends that only count


def counts(kind: EndpointKind, matched: int) -> Edit:
    """One end counts and the other says nothing."""
    other = SUB if kind is PUB else PUB
    return both(change_report(kind, "/a", matched=matched), silent(other))


def stranger(kind: EndpointKind, **fields: object) -> Edit:
    return add_endpoint(kind, "/rviz2", "/a", gid="99", **fields)


TWO_READERS = planned(
    node("one", publisher("a")), node("two", subscription("a")), node("three", subscription("a"))
)
RELIABLE = QosProfile()
BEST = QosProfile(reliability=Reliability.BEST_EFFORT)


@pytest.mark.parametrize(
    ("plan", "edit", "expected"),
    [
        (pair(), counts(PUB, 1), []),
        (pair(), counts(SUB, 1), []),
        (pair(), counts(PUB, 0), [("violated", "the publisher matched none")]),
        (pair(), counts(SUB, 0), [("violated", "the subscription matched none")]),
        (
            pair(),
            counts(PUB, 2),
            [("unverifiable", "the publisher matched 2 of 1, and does not tell which")],
        ),
        (
            pair(),
            both(counts(PUB, 1), stranger(SUB, qos=BEST)),
            [("unverifiable", "the publisher matched 1 of 2, and does not tell which")],
        ),
        (
            pair(),
            both(counts(PUB, 0), stranger(SUB, qos=BEST)),
            [("violated", "the publisher matched none")],
        ),
        (pair(), both(counts(PUB, 2), stranger(SUB, qos=None)), []),
        (pair(), both(counts(SUB, 2), stranger(PUB, qos=None)), []),
        (TWO_READERS, counts(PUB, 1), [("violated", "the publisher matched 1 of 2")] * 2),
    ],
)
def test_a_count_proves_a_pair_only_if_it_is_that_of_all_who_can_match(plan, edit, expected):
    assert said(edit, plan) == expected


@pytest.mark.parametrize(
    ("kind", "matched", "expected"),
    [
        (PUB, 1, []),
        (PUB, 2, []),
        (SUB, 2, []),
        (PUB, 0, [("violated", "the publisher matched none")]),
        (
            PUB,
            3,
            [("unverifiable", "the publisher matched 3 of 1, and does not tell which")],
        ),
    ],
)
def test_a_peer_whose_process_was_killed_may_be_counted_still(kind, matched, expected):
    def edit(seen: Observation) -> Observation:
        ended = SUB if kind is PUB else PUB
        (gone,) = (each for each in seen.endpoints if each.kind is ended)
        departed = (replace(gone, gid="77", node=""),)
        return replace(counts(kind, matched)(seen), departed=departed)

    assert said(edit, pair()) == expected
    closed = planned(node("one", publisher("a")), node("two", subscription("a")))
    verdict = verify(closed, edit(perfect(closed)), stage=Stage.CONNECTED)
    assert ("graph.unknown-peer" in {each.rule for each in verdict.findings}) == (matched == 3)


@pytest.mark.parametrize(
    ("kind", "qos", "other"),
    [
        (PUB, BEST, {"qos": RELIABLE}),
        (SUB, RELIABLE, {"qos": BEST}),
        (PUB, RELIABLE, {"qos": RELIABLE, "type": INT}),
        (SUB, RELIABLE, {"qos": RELIABLE, "type": INT}),
    ],
)
def test_who_cannot_match_is_not_counted(kind, qos, other):
    stranger_kind = SUB if kind is PUB else PUB
    edit = both(counts(kind, 1), stranger(stranger_kind, **other))
    assert said(edit, pair(qos)) == []
    # The other way round the two would match, and so would an end of any QoS.
    fitting = stranger(stranger_kind, qos=qos)
    assert said(both(counts(kind, 2), fitting), pair(qos)) == []


def test_endpoints_of_other_topics_are_not_counted():
    edit = both(counts(PUB, 1), add_endpoint(SUB, "/rviz2", "/b", gid="99", qos=BEST))
    assert said(edit, pair()) == []


def test_a_pair_that_may_be_matched_is_unverifiable_and_told_whole():
    unsure = both(stranger(SUB, qos=RELIABLE), silent(SUB))
    (found,) = matching(unsure, pair())
    reason = "the publisher matched 1 of 2, and does not tell which"
    assert (found.outcome, found.observed) == (Outcome.UNVERIFIABLE, reason)
