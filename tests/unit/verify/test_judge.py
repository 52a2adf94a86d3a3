"""What a verdict lists beside its findings, and what blocks."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import (
    Endpoint,
    EndpointKind,
    EndpointPolicy,
    Policy,
)
from lifecycle.manifest.qos import QosProfile
from lifecycle.plan.model import Plan
from lifecycle.verify.judge import with_findings, without_findings
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.tool_filter import takes_diagnostics
from lifecycle.verify.verdict import Stage, ToleratedNode, Verdict
from tests.builders import need, node, planned, publisher, subscription
from tests.unit.verify.edits import Edit, add_endpoint, add_node, both, change_report, drop_node
from tests.unit.verify.lines import verify
from tests.unit.verify.perfect import perfect

PUB, SUB = EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION
CLIENT, SERVER = EndpointKind.SERVICE_CLIENT, EndpointKind.SERVICE_SERVER


def plan_of(**policy: object) -> Plan:
    return planned(
        node("one", publisher("a"), endpoints=EndpointPolicy.OPEN),
        node("two", subscription("a")),
        policy=Policy(**policy),
    )


def judged(plan: Plan, *edits: Edit) -> Verdict:
    return verify(plan, both(*edits)(perfect(plan)), stage=Stage.CONNECTED)


def test_a_verdict_without_a_finding_is_as_if_it_had_not_been_made_its_flows_too() -> None:
    plan = planned(
        node("one", publisher("a")),
        node("two", subscription("a")),
        node("three", subscription("a")),
    )
    verdict = judged(plan, change_report(PUB, "/a", matched=3), drop_node("/three"))
    peer = [each for each in verdict.findings if each.rule == "graph.unknown-peer"]
    assert [each.outcome for each in verdict.flows] == [Outcome.VIOLATED] * 2
    without = without_findings(verdict, peer, plan.policy)
    assert [each.outcome for each in without.flows] == [Outcome.OK, Outcome.VIOLATED]
    assert without.verdict is Outcome.VIOLATED
    nothing = without_findings(verdict, verdict.findings, plan.policy)
    assert (nothing.verdict, nothing.findings, nothing.blocking) == (Outcome.OK, (), False)
    assert {each.outcome for each in nothing.flows} == {Outcome.OK}


def test_what_a_supervisor_finds_itself_comes_first_and_makes_a_verdict_no_better() -> None:
    plan = plan_of()
    good, bad = judged(plan), judged(plan, add_node("/spy"))
    unsure = (replace(bad.findings[0], outcome=Outcome.UNVERIFIABLE),)
    assert with_findings(good, (), plan.policy) is good
    for verdict, found, outcome, blocks in (
        (good, bad.findings, Outcome.VIOLATED, True),
        (bad, unsure, Outcome.VIOLATED, True),
        (good, unsure, Outcome.UNVERIFIABLE, False),
    ):
        added = with_findings(verdict, found, plan.policy)
        assert (added.verdict, added.blocking) == (outcome, blocks)
        assert added.findings == (*found, *verdict.findings)


LISTENERS = both(
    add_node("/rviz2"),
    add_endpoint(SUB, "/rviz2", "/a", gid="1", qos=QosProfile()),
    add_endpoint(CLIENT, "/rviz2", "/ask", type="a/srv/B"),
    add_endpoint(SUB, "/_ros2cli_7", "/a", gid="2", qos=QosProfile()),
    add_node("/launch_ros_1"),
)
TOOLS = (
    ToleratedNode(node="/_ros2cli_7", because="tolerated_nodes: _ros2cli_*"),
    ToleratedNode(node="/launch_ros_1", because="tolerated_nodes: launch_ros_*"),
    ToleratedNode(node="/rviz2", because="tolerated_nodes: rviz2"),
)


def test_tools_are_listed_with_what_they_have_and_the_pattern_that_tolerates_them() -> None:
    verdict = judged(plan_of(), LISTENERS)
    assert (verdict.verdict, verdict.findings) == (Outcome.OK, ())
    assert verdict.tolerated == TOOLS


ARRAY, TRIGGER = "diagnostic_msgs/msg/DiagnosticArray", "std_srvs/srv/Trigger"
ONE_PARTICIPANT = "10000000000000000000000a"


def supervisor(number: int, system: str = "robot", *, participant: str = ONE_PARTICIPANT) -> Edit:
    """What a supervisor has in ROS, at `participant` and a number."""
    name, prefix = f"/_lifecycle_observer_{number}", f"{participant[:-1]}{number}"
    return both(
        add_node(name),
        add_endpoint(PUB, name, "/diagnostics", gid=f"{prefix}1", type=ARRAY, qos=QosProfile()),
        add_endpoint(PUB, name, f"/lifecycle/{system}/status", gid=f"{prefix}2", qos=QosProfile()),
        add_endpoint(SERVER, name, f"/lifecycle/{system}/get_status", type=TRIGGER),
    )


def rules(plan: Plan, *edits: Edit) -> list[tuple[str, str, str]]:
    return [(each.rule, each.node, each.subject) for each in judged(plan, *edits).findings]


def test_what_a_supervisor_offers_in_ros_is_its_own_and_no_one_elses() -> None:
    server_rule = "graph.undeclared-service-server"
    plan = plan_of()
    verdict = judged(plan, supervisor(1), supervisor(2, "others"))
    assert (verdict.verdict, verdict.tolerated) == (Outcome.OK, ())
    tool = add_endpoint(SERVER, "/rqt_1", "/lifecycle/robot/pause", type=TRIGGER)
    assert rules(plan, supervisor(1), tool) == [(server_rule, "/rqt_1", "/lifecycle/robot/pause")]


def test_who_reads_diagnostics_has_those_of_supervisors_and_of_nobody_else() -> None:
    reads = node("one", publisher("a"), subscription("/diagnostics", ARRAY))
    plan = planned(reads, node("two", subscription("a")), policy=Policy())
    of_diagnostics = "graph.undeclared-publisher", "/diagnostics"

    def found(*edits: Edit) -> list[tuple[str, str]]:
        return [(rule, subject) for rule, _, subject in rules(plan, *edits)]

    assert found(supervisor(1)) == []
    assert found(supervisor(1), supervisor(2, "another")) == []

    def publishes(name: str, gid: str) -> Edit:
        return both(
            add_node(name),
            add_endpoint(PUB, name, "/diagnostics", gid=gid, type=ARRAY, qos=QosProfile()),
        )

    assert found(supervisor(1), publishes("/rqt_robot_monitor", "7" * 25)) == [of_diagnostics]


@pytest.mark.parametrize(
    ("end", "publishes"),
    [
        (subscription("/diagnostics", ARRAY), True),
        (publisher("/diagnostics", ARRAY), True),
        (subscription("/diagnostics", "my_msgs/msg/Diagnostics"), False),
    ],
)
def test_a_supervisor_does_not_publish_diagnostics_where_it_would_disturb(
    end: Endpoint, publishes: bool
) -> None:
    assert takes_diagnostics(planned(node("one", end))) is publishes


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
        policy=Policy(unverifiable="block" if asked else "allow"),
    )
    verdict = judged(plan, edit)
    assert (verdict.verdict, verdict.blocking) == (outcome, blocks)
