"""What is seen, laid beside what is planned: whose it is, and what is left over."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import EndpointKind
from lifecycle.manifest.qos import Durability, History, Liveliness, QosProfile, Reliability
from lifecycle.plan.build import build_plan
from lifecycle.plan.model import ParticipantConnections, Plan
from lifecycle.verify.matcher import lay_out
from lifecycle.verify.observation import Observation, ObservedEndpoint
from lifecycle.verify.verdict import Stage
from lifecycle.verify.view import Actual, View, Whose, actual_qos
from tests.builders import node, planned, publisher, subscription, teleop
from tests.unit.verify.edits import (
    Edit,
    add_endpoint,
    both,
    change_configuration,
    change_endpoint,
    change_report,
    drop_endpoint,
)
from tests.unit.verify.perfect import perfect

PUB, SUB = EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION
SERVER, CLIENT = EndpointKind.SERVICE_SERVER, EndpointKind.SERVICE_CLIENT
STATUS = "/robot/status"
STRING, TRIGGER = "std_msgs/msg/String", "std_srvs/srv/Trigger"
PLAN = build_plan(teleop(), environment={})


def view_after(edit: Edit, plan: Plan = PLAN, **rest: object) -> View:
    return lay_out(plan, edit(perfect(plan)), Stage.CONNECTED, **rest)


def actual(view: View, kind: EndpointKind, name: str) -> Actual:
    (found,) = (
        each for each in view.actual if (each.planned.kind, each.planned.resolved) == (kind, name)
    )
    return found


# --- whose an endpoint is


def nameless_service(name: str, kind: EndpointKind = SERVER, type_: str = TRIGGER) -> Edit:
    """A service of an unknown node on the participant of the camera's publishers."""

    def edit(seen: Observation) -> Observation:
        camera = next(each for each in seen.configurations if each.name == "/robot/camera")
        prefix = camera.endpoints[2].gid[:24]
        return add_endpoint(kind, "", name, type=type_, gid=f"{prefix}00001204")(seen)

    return edit


def test_a_part_of_an_action_of_no_node_is_that_of_the_node_that_declares_the_action() -> None:
    dock = "/robot/dock/_action"
    view = view_after(nameless_service(f"{dock}/send_goal", type_="robot/action/Dock_SendGoal"))
    assert view.others == ()
    view = view_after(nameless_service("/other/_action/send_goal"))
    assert [each.name for each in view.of(Whose.UNKNOWN)] == ["/other/_action/send_goal"]


# --- matching


def test_a_nameless_report_of_the_declared_type_is_chosen_where_discovery_shows_none() -> None:
    plan = connected("udpv4://10.0.0.1:7911")
    report = perfect(plan).configurations[0].endpoints[0]
    right = replace(report, name="", type_hash="h")
    wrong = replace(right, type="std_msgs/msg/Int32", gid="99")
    edit = both(drop_endpoint(PUB, "/a"), change_configuration("/one", endpoints=(wrong, right)))
    view = view_after(edit, plan)
    assert actual(view, PUB, "/a").report == right
    assert actual(view, PUB, "/a").observed == ObservedEndpoint(
        kind=PUB, node="/one", name="/a", type=STRING, qos=right.qos, gid=right.gid, type_hash="h"
    )
    assert [each.type for each in view.of(Whose.UNDECLARED)] == ["std_msgs/msg/Int32"]


# --- what discovery need not show


def connected(url: str) -> Plan:
    """Two nodes that are told how to connect, each on its machine."""
    plan = planned(
        node("one", publisher("a"), machine="m1"),
        node("two", subscription("a"), subscription("b"), machine="m2"),
    )
    connections = ParticipantConnections(urls=(url,))
    return replace(plan, nodes=tuple(replace(each, connections=connections) for each in plan.nodes))


# --- what is seen of topics


def test_discovery_wins_over_a_report_where_it_knows_a_policy() -> None:
    known = QosProfile(
        history=History.KEEP_ALL,
        depth=3,
        reliability=Reliability.BEST_EFFORT,
        durability=Durability.TRANSIENT_LOCAL,
        deadline_ns=7,
        lifespan_ns=8,
        liveliness=Liveliness.MANUAL_BY_TOPIC,
        liveliness_lease_duration_ns=9,
    )
    reported = QosProfile(depth=4, deadline_ns=1, lifespan_ns=2, liveliness_lease_duration_ns=3)
    assert actual_qos(known, reported) == known
    policies = {
        "history": History.UNKNOWN,
        "reliability": Reliability.UNKNOWN,
        "durability": Durability.UNKNOWN,
        "liveliness": Liveliness.UNKNOWN,
    }
    times = {each: getattr(known, each) for each in QosProfile.__struct_fields__ if "_ns" in each}
    assert actual_qos(replace(known, depth=0, **policies), reported) == replace(reported, **times)
    assert (actual_qos(known, None), actual_qos(None, known)) == (known, known)


@pytest.mark.parametrize(
    ("shown", "reported", "known"),
    [
        ("d", "r", "d"),
        ("", "r", "r"),
        (None, "r", "r"),
        (None, "", ""),
        ("", None, ""),
        ("d", None, "d"),
        (None, None, None),
    ],
)
def test_the_hash_that_discovery_shows_wins_over_the_reported_one(shown, reported, known) -> None:
    edit = both(
        change_endpoint(PUB, STATUS, type_hash=shown),
        change_report(PUB, STATUS, type_hash=reported),
    )
    (seen,) = view_after(edit).topics[STATUS][0]
    assert seen.type_hash == known
    foreign = add_endpoint(PUB, "/guest", "/x", gid="99", type_hash=shown)
    (seen,) = view_after(foreign).of(Whose.FOREIGN)
    assert seen.type_hash == shown
