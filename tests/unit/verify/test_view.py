"""What the view answers of itself, and how announced and reported QoS are one."""

from __future__ import annotations

import dataclasses

import pytest

from lifecycle.manifest.model import EndpointKind, Machine, Run, RunKind
from lifecycle.manifest.qos import Durability, History, Liveliness, QosProfile, Reliability
from lifecycle.network.nfe import UniqueRequirement
from lifecycle.plan.model import (
    ParticipantConnections,
    Plan,
    PlannedParticipant,
    StaticParticipant,
)
from lifecycle.verify.matcher import lay_out
from lifecycle.verify.observation import Observation
from lifecycle.verify.verdict import Stage
from lifecycle.verify.view import (
    UNKNOWN_QOS,
    View,
    actual_qos,
    connection_of,
    may_hide,
    only_shared_memory,
)
from tests.builders import at, need, node, planned, publisher, subscription
from tests.unit.verify.edits import (
    Edit,
    both,
    drop_endpoint,
    drop_node,
    drop_report,
)
from tests.unit.verify.perfect import perfect

PUB = EndpointKind.PUBLISHER
SHM = ParticipantConnections(urls=("shm://",))
UDP = ParticipantConnections(urls=("udpv4://10.0.0.1:7911",))
MIXED = ParticipantConnections(urls=("shm://", "udpv4://10.0.0.1:7911"))
STATIC = ParticipantConnections(static_participants=(StaticParticipant(name="/one", endpoints=()),))
PLAN = planned(
    node("one", publisher("a"), machine="m1"),
    node("two", subscription("a"), run=Run(kind=RunKind.ATTACH), managed=False, machine="m2"),
    node("three"),
    machines=(Machine(name="m1", address="10.0.0.1", at=at(2)), Machine(name="m2", at=at(2))),
)
ONE = PLAN.nodes[0]


def view_of(
    seen: Observation | None = None, plan: Plan = PLAN, machines: frozenset[str] | None = None
) -> View:
    return lay_out(plan, seen or perfect(plan), Stage.CONNECTED, machines=machines)


# --- nodes


@pytest.mark.parametrize(
    ("edit", "absent"),
    [
        (drop_report("/one"), False),
        (drop_node("/one"), False),
        (drop_endpoint(PUB, "/a"), False),
        (both(drop_node("/one"), drop_endpoint(PUB, "/a")), True),
    ],
)
def test_a_node_of_which_nothing_is_seen_is_absent(edit: Edit, absent: bool) -> None:
    assert view_of(edit(perfect(PLAN))).nodes["/one"].absent is absent


# --- connections


@pytest.mark.parametrize(
    ("connections", "only", "hides"),
    [
        (SHM, True, True),
        (MIXED, False, True),
        (UDP, False, True),
        (STATIC, False, True),
        (ParticipantConnections(), False, False),
    ],
)
def test_discovery_need_not_show_what_was_told_how_to_connect(
    connections: ParticipantConnections, only: bool, hides: bool
) -> None:
    (end,) = ONE.endpoints
    assert only_shared_memory(connections) is only
    assert may_hide(dataclasses.replace(ONE, connections=connections), end) is hides
    carried = dataclasses.replace(end, participant="_one_net")
    others = PlannedParticipant(name="_one_x", dscp=None, reason="", connection="x")
    its = PlannedParticipant(
        name="_one_net", dscp=None, reason="", connection="net", connections=connections
    )
    on_its_own = dataclasses.replace(ONE, participants=(others, its))
    assert may_hide(on_its_own, carried) is hides
    assert may_hide(on_its_own, end) is False
    assert [connection_of(on_its_own, each) for each in (carried, end)] == ["net", ""]


# --- flows


def flow_of(plan: Plan):
    (flow,) = view_of(plan=plan).flows
    return flow


@pytest.mark.parametrize(
    ("asked", "strongest"),
    [
        (("strictly", "optionally"), "strictly"),
        (("optionally", "strictly"), "strictly"),
        (("optionally", "default"), "optionally"),
        (("default", "not"), "default"),
        (("not", "optionally"), "optionally"),
        (("not", "not"), "not"),
    ],
)
def test_several_endpoints_of_one_end_require_what_the_strictest_does(asked, strongest) -> None:
    spelled = {
        "strictly": UniqueRequirement.STRICTLY_REQUIRED,
        "optionally": UniqueRequirement.OPTIONALLY_REQUIRED,
        "default": UniqueRequirement.SYSTEM_DEFAULT,
        "not": UniqueRequirement.NOT_REQUIRED,
    }
    plan = planned(
        node(
            "one",
            publisher("a"),
            publisher("/a"),
            needs=[
                need(PUB, name, spelled[each])
                for name, each in zip(("a", "/a"), asked, strict=True)
            ],
        ),
        node("two", subscription("a")),
    )
    assert flow_of(plan).requirement == (spelled[strongest], spelled["not"])


@pytest.mark.parametrize(
    ("asked", "planned_5qi"),
    [((85, 85), 85), ((85, 83), None), ((None, 85), None), ((None, None), None)],
)
def test_a_flow_has_a_5qi_where_all_its_publishers_have_the_same(asked, planned_5qi) -> None:
    plan = planned(node("one", publisher("a"), publisher("/a")), node("two", subscription("a")))
    one = dataclasses.replace(
        plan.nodes[0],
        endpoints=tuple(
            dataclasses.replace(end, five_qi=each)
            for end, each in zip(plan.nodes[0].endpoints, asked, strict=True)
        ),
    )
    assert flow_of(dataclasses.replace(plan, nodes=(one, plan.nodes[1]))).five_qi == planned_5qi


# --- QoS

ANNOUNCED = QosProfile(
    history=History.KEEP_ALL,
    depth=7,
    reliability=Reliability.BEST_EFFORT,
    durability=Durability.TRANSIENT_LOCAL,
    deadline_ns=1,
    lifespan_ns=2,
    liveliness=Liveliness.MANUAL_BY_TOPIC,
    liveliness_lease_duration_ns=3,
)
REPORTED = QosProfile(
    history=History.KEEP_LAST,
    depth=5,
    reliability=Reliability.RELIABLE,
    durability=Durability.VOLATILE,
    deadline_ns=10,
    lifespan_ns=20,
    liveliness=Liveliness.AUTOMATIC,
    liveliness_lease_duration_ns=30,
)


@pytest.mark.parametrize(
    ("announced", "reported", "known"),
    [
        ({}, {}, {}),
        ({"history": History.UNKNOWN}, {}, {"history": History.KEEP_LAST, "depth": 5}),
        ({"reliability": Reliability.UNKNOWN}, {}, {"reliability": Reliability.RELIABLE}),
        ({"durability": Durability.UNKNOWN}, {}, {"durability": Durability.VOLATILE}),
        ({"liveliness": Liveliness.UNKNOWN}, {}, {"liveliness": Liveliness.AUTOMATIC}),
        ({}, {"history": History.UNKNOWN, "reliability": Reliability.UNKNOWN}, {}),
    ],
)
def test_discovery_wins_where_it_knows_a_policy_and_the_report_elsewhere(
    announced: dict, reported: dict, known: dict
) -> None:
    combined = actual_qos(
        dataclasses.replace(ANNOUNCED, **announced), dataclasses.replace(REPORTED, **reported)
    )
    assert combined == dataclasses.replace(ANNOUNCED, **known)


def test_where_only_one_tells_a_profile_it_is_that_one() -> None:
    assert actual_qos(ANNOUNCED, None) == ANNOUNCED
    assert actual_qos(None, REPORTED) == REPORTED
    assert actual_qos(None, None) is None
    assert actual_qos(UNKNOWN_QOS, None) == UNKNOWN_QOS
