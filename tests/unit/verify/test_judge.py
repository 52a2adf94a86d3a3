"""What a verdict lists beside its findings, and what blocks."""

from __future__ import annotations

import dataclasses

import pytest

from lifecycle.manifest.model import EndpointKind, EndpointPolicy, Policy, RosInterfaceAccess
from lifecycle.manifest.qos import QosProfile
from lifecycle.plan import Plan
from lifecycle.verify import Outcome, Stage, Verdict, verify
from lifecycle.verify.verdict import OpenEndpoint, ToleratedNode
from tests.builders import need, node, planned, publisher, subscription
from tests.unit.verify.edits import Edit, add_endpoint, add_node, both, change_report
from tests.unit.verify.perfect import perfect

PUB, SUB = EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION
CLIENT, SERVER = EndpointKind.SERVICE_CLIENT, EndpointKind.SERVICE_SERVER
READ_ONLY = RosInterfaceAccess.READ_ONLY
STRING = "std_msgs/msg/String"


def plan_of(**policy: object) -> Plan:
    return planned(
        node("one", publisher("a"), endpoints=EndpointPolicy.OPEN),
        node("two", subscription("a")),
        policy=Policy(**policy),
    )


def judged(plan: Plan, *edits: Edit) -> Verdict:
    return verify(plan, both(*edits)(perfect(plan)), stage=Stage.CONNECTED)


def has(kind: EndpointKind, node: str, name: str, type_: str = STRING) -> OpenEndpoint:
    return OpenEndpoint(kind=kind, node=node, name=name, type=type_)


def test_undeclared_endpoints_of_nodes_that_may_have_such_are_listed_and_no_others() -> None:
    verdict = judged(
        plan_of(),
        add_endpoint(PUB, "/one", "/extra", gid="1"),
        add_endpoint(CLIENT, "/one", "/ask", type="a/srv/B"),
        add_endpoint(PUB, "/two", "/other", gid="2"),
    )
    assert verdict.open_endpoints == (
        has(CLIENT, "/one", "/ask", "a/srv/B"),
        has(PUB, "/one", "/extra"),
    )
    assert [each.subject for each in verdict.findings] == ["/other"]
    assert verdict.tolerated == ()


LISTENERS = both(
    add_node("/rviz2"),
    add_endpoint(SUB, "/rviz2", "/a", gid="1", qos=QosProfile()),
    add_endpoint(CLIENT, "/rviz2", "/ask", type="a/srv/B"),
    add_endpoint(SUB, "/_ros2cli_7", "/a", gid="2", qos=QosProfile()),
    add_node("/launch_ros_1"),
)
TOOLS = (
    ToleratedNode(
        node="/_ros2cli_7",
        because="tolerated_nodes: _ros2cli_*",
        endpoints=(has(SUB, "/_ros2cli_7", "/a"),),
    ),
    ToleratedNode(node="/launch_ros_1", because="tolerated_nodes: launch_ros_*"),
    ToleratedNode(
        node="/rviz2",
        because="tolerated_nodes: rviz2",
        endpoints=(has(SUB, "/rviz2", "/a"), has(CLIENT, "/rviz2", "/ask", "a/srv/B")),
    ),
)


def test_tools_are_listed_with_what_they_have_and_the_pattern_that_tolerates_them() -> None:
    verdict = judged(plan_of(), LISTENERS)
    assert (verdict.verdict, verdict.findings) == (Outcome.OK, ())
    assert verdict.tolerated == TOOLS


def test_observers_are_listed_only_where_they_do_more_than_observe() -> None:
    name = "/_lifecycle_observer_1"
    assert judged(plan_of(), add_node(name)).tolerated == ()
    listens = add_endpoint(SUB, name, "/a", gid="1", qos=QosProfile())
    assert judged(plan_of(), add_node(name), listens).tolerated == (
        ToleratedNode(
            node=name, because="tolerated_nodes: _lifecycle_*", endpoints=(has(SUB, name, "/a"),)
        ),
    )


def test_what_supervisors_offer_in_ros_is_theirs_but_of_no_more_than_there_are_machines() -> None:
    ours, other = "/_lifecycle_observer_1", "/_lifecycle_observer_2"
    array, trigger = "diagnostic_msgs/msg/DiagnosticArray", "std_srvs/srv/Trigger"

    def offers(name: str, gid: str) -> Edit:
        return both(
            add_node(name),
            add_endpoint(PUB, name, "/diagnostics", gid=gid, type=array, qos=QosProfile()),
            add_endpoint(PUB, name, "/lifecycle/robot/status", gid=gid * 2, qos=QosProfile()),
            add_endpoint(SERVER, name, "/lifecycle/robot/pause", type=trigger),
        )

    assert judged(plan_of(), offers(ours, "1"), offers(other, "2")).tolerated == ()
    # The manifest declares what reads it.
    reads = node("one", publisher("a"), subscription("/diagnostics", array))
    on = planned(reads, node("two", subscription("a")), policy=Policy(ros_interface=READ_ONLY))
    assert judged(on, offers(ours, "1")).verdict is Outcome.OK
    strangers = judged(on, offers(ours, "1"), offers(other, "2")).findings
    assert [(each.rule, each.node) for each in strangers] == [
        ("graph.undeclared-publisher", ours),
        ("graph.undeclared-publisher", other),
    ]
    as_rviz = judged(on, offers("/rviz2", "1")).findings
    assert [each.rule for each in as_rviz] == ["graph.undeclared-publisher"]
    off = dataclasses.replace(on, policy=Policy())
    assert judged(off, offers(ours, "1")).verdict is Outcome.VIOLATED


def test_who_else_is_there_is_listed_in_an_open_system_and_nobody_else() -> None:
    others = both(
        add_node("/guest"),
        add_endpoint(PUB, "/stranger", "/x", gid="3"),
        add_endpoint(PUB, "", "/y", gid="4"),
        add_endpoint(SUB, "/guest", "/a", gid="5", qos=QosProfile()),
        LISTENERS,
        add_node("/_lifecycle_observer_1"),
        add_node("/quiet"),
    )
    opened = judged(plan_of(undeclared_nodes=EndpointPolicy.OPEN), others)
    because = "undeclared_nodes: open"
    assert opened.tolerated == (
        ToleratedNode(node="", because=because, endpoints=(has(PUB, "", "/y"),)),
        TOOLS[0],
        ToleratedNode(node="/guest", because=because, endpoints=(has(SUB, "/guest", "/a"),)),
        TOOLS[1],
        ToleratedNode(node="/quiet", because=because),
        TOOLS[2],
        ToleratedNode(node="/stranger", because=because, endpoints=(has(PUB, "/stranger", "/x"),)),
    )
    assert judged(plan_of(), others).tolerated == TOOLS


NOT_ENFORCED = need(PUB, "a", dscp=46, enforce=False)


@pytest.mark.parametrize(
    ("edit", "asked", "outcome", "blocks"),
    [
        (change_report(SUB, "/a", qos=None), False, Outcome.UNVERIFIABLE, False),
        (change_report(SUB, "/a", qos=None), True, Outcome.UNVERIFIABLE, True),
        (change_report(PUB, "/a", dscp=0), True, Outcome.UNVERIFIABLE, False),
        (add_node("/spy"), False, Outcome.VIOLATED, True),
        (
            both(change_report(PUB, "/a", dscp=0), add_node("/spy")),
            True,
            Outcome.VIOLATED,
            True,
        ),
    ],
)
def test_what_is_violated_blocks_and_what_is_unverifiable_where_rule_and_policy_say_so(
    edit: Edit, asked: bool, outcome: Outcome, blocks: bool
) -> None:
    plan = planned(
        node("one", publisher("a"), needs=[NOT_ENFORCED]),
        node("two", subscription("a")),
        policy=Policy(unverifiable_blocks=asked),
    )
    verdict = judged(plan, edit)
    assert (verdict.verdict, verdict.blocking) == (outcome, blocks)


def test_a_verdict_of_what_was_seen_is_judged_and_of_no_run() -> None:
    verdict = judged(plan_of())
    assert (verdict.judged, verdict.run, verdict.open_endpoints) == (True, None, ())
    assert [each.topic for each in verdict.flows] == ["/a"]
