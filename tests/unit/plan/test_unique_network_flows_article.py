"""The design article *Unique Network Flows* as the manifest, the planner and the verifier apply it.

Definitions and identifiers are tested in tests/unit/network/test_nfe.py and test_flow.py, the table
of 5QIs in test_five_qi.py; tests/articles/unique_network_flows.md lists every part of the article
with its test.
"""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import EndpointKind, Link, Machine, Manifest, UniqueHow
from lifecycle.network.nfe import NetworkFlowEndpoint, UniqueRequirement
from lifecycle.plan.build import build_plan
from lifecycle.verify.judge import verify
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import Stage
from tests.builders import at, link, manifest, need, nfe, node, publisher, subscription
from tests.unit.verify.edits import change_report
from tests.unit.verify.perfect import perfect

PUB, SUB = EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION
NOT, STRICTLY, OPTIONALLY, DEFAULT = (
    UniqueRequirement.NOT_REQUIRED,
    UniqueRequirement.STRICTLY_REQUIRED,
    UniqueRequirement.OPTIONALLY_REQUIRED,
    UniqueRequirement.SYSTEM_DEFAULT,
)
EMPTY = "std_msgs/msg/Empty"


def verdict_of(system: Manifest, *edits):
    plan = build_plan(system, environment={})
    seen = perfect(plan)
    for edit in edits:
        seen = edit(seen)
    return verify(plan, seen, stage=Stage.CONNECTED)


# --- the problem and its example


def devices(*, unique: UniqueRequirement, links: list[Link]) -> Manifest:
    """N1 on D1 publishes video (P1) and battery status (P2); N2 on D2 subscribes to both."""
    return replace(
        manifest(
            node(
                "n1",
                publisher("video", EMPTY),
                publisher("battery", EMPTY),
                needs=[need(PUB, "video", unique)],
                machine="d1",
            ),
            node(
                "n2",
                subscription("video", EMPTY),
                subscription("battery", EMPTY),
                needs=[need(SUB, "video", unique)],
                machine="d2",
            ),
            links=links,
        ),
        machines=(
            Machine(name="d1", address="10.0.0.1", at=at(1)),
            Machine(name="d2", address="10.0.0.2", at=at(1)),
        ),
    )


def test_the_example_without_a_requirement_has_one_flow_for_both_links():
    video, battery = verdict_of(devices(unique=NOT, links=[])).flows
    assert (video.source, video.destination) == (battery.source, battery.destination)
    assert video.unique is battery.unique is UniqueHow.NOT


def test_the_example_with_unique_flows_tells_p1_s1_from_p2_s2():
    links = [link("/video", "n1", "n2", unique=UniqueHow.STRONGLY, max_delay_ms=5.0)]
    verdict = verdict_of(devices(unique=STRICTLY, links=links))
    video, battery = verdict.flows
    assert (verdict.verdict, video.unique) == (Outcome.OK, UniqueHow.STRONGLY)
    assert not set(video.source) & set(battery.source)
    assert not set(video.destination) & set(battery.destination)


# --- unique_network_flow_endpoints_requirement_t


def one(requirement: UniqueRequirement) -> Manifest:
    return manifest(
        node(
            "n",
            publisher("a", EMPTY),
            publisher("b", EMPTY),
            subscription("c", EMPTY),
            subscription("d", EMPTY),
            needs=[need(PUB, "a", requirement), need(SUB, "c", requirement)],
        )
    )


SHARED = (
    change_report(PUB, "/a", nfes=()),
    *(
        change_report(
            kind,
            name,
            nfes=(nfe("127.0.0.1", 7411),),
        )
        for kind, name in ((PUB, "/a"), (PUB, "/b"), (SUB, "/c"), (SUB, "/d"))
    ),
)
"""What an RMW would show that made nothing unique."""


@pytest.mark.parametrize(
    ("requirement", "participants", "rules"),
    [
        (NOT, 0, []),
        (STRICTLY, 1, ["flow.not-unique", "flow.not-unique"]),
        (OPTIONALLY, 1, []),
        (DEFAULT, 0, []),
    ],
)
def test_a_requirement_says_what_is_tried_and_what_may_fail(
    requirement: UniqueRequirement, participants: int, rules: list[str]
):
    system = one(requirement)
    plan = build_plan(system, environment={})
    assert len(plan.nodes[0].participants) == participants
    assert [each.rule for each in verdict_of(system).findings] == []
    assert [each.rule for each in verdict_of(system, *SHARED).findings] == rules


def test_unique_network_flow_endpoints_not_required_is_the_default():
    (endpoint,) = build_plan(manifest(node("n", publisher("a"))), environment={}).nodes[0].endpoints
    assert endpoint.unique is NOT


def test_unique_network_flow_endpoints_system_default_reports_what_came_of_it():
    system = manifest(
        node("one", publisher("c", EMPTY)),
        node(
            "two",
            subscription("c", EMPTY),
            subscription("d", EMPTY),
            needs=[need(SUB, "c", DEFAULT)],
        ),
    )
    side_loaded = change_report(
        SUB,
        "/c",
        nfes=(nfe("127.0.0.1", 7042),),
    )
    (left_alone,) = verdict_of(system).flows
    (loaded,) = verdict_of(system, side_loaded).flows
    # The publisher is alone on its side, so what differs is the subscription.
    assert (left_alone.unique, loaded.unique) == (UniqueHow.WEAKLY, UniqueHow.STRONGLY)
    assert loaded.requirement == (NOT, DEFAULT)


def test_the_article_s_snippet_of_sub_x_sub_y_and_pub_z():
    system = manifest(
        node(
            "my_node",
            subscription("topic_x", EMPTY),
            subscription("topic_y", EMPTY),
            publisher("topic_z", EMPTY),
            needs=[need(SUB, "topic_x", STRICTLY), need(PUB, "topic_z", OPTIONALLY)],
        )
    )
    plan = build_plan(system, environment={})
    assert [(each.name, each.unique) for each in plan.nodes[0].endpoints] == [
        ("topic_x", STRICTLY),
        ("topic_y", NOT),
        ("topic_z", OPTIONALLY),
    ]
    assert verdict_of(system).verdict is Outcome.OK


# --- what an RMW may do: port, flow label, DSCP


def test_candidate_ipv6_flow_label_tells_two_equal_5_tuples_apart():
    def labelled(label: int) -> tuple[NetworkFlowEndpoint, ...]:
        return (nfe("fd00::1", 40000, flow_label=label),)

    system = one(STRICTLY)
    same = (change_report(PUB, "/a", nfes=labelled(1)), change_report(PUB, "/b", nfes=labelled(1)))
    other = (change_report(PUB, "/a", nfes=labelled(1)), change_report(PUB, "/b", nfes=labelled(2)))
    assert [each.rule for each in verdict_of(system, *same).findings] == ["flow.not-unique"]
    assert verdict_of(system, *other).findings == ()


# --- alternative solutions


def test_alternative_1_dedicated_nodes_need_a_process_each_and_no_participants_of_ours():
    """Each stream in a node and process of its own: unique, at the price of nodes."""
    dedicated = manifest(
        *(node(f"only_{name}", publisher(name, EMPTY)) for name in ("a", "b")),
        *(node(f"only_{name}", subscription(name, EMPTY)) for name in ("c", "d")),
    )
    plan = build_plan(dedicated, environment={})
    assert [each.participants for each in plan.nodes] == [()] * 4
    assert len(plan.processes) == 4
