"""The one line that a passed deadline says."""

from __future__ import annotations

import dataclasses

from lifecycle.manifest.model import EndpointKind, Policy
from lifecycle.plan import build_plan
from lifecycle.verify import Stage, missing, not_ok, verify
from tests.unit.plan.samples import teleop
from tests.unit.verify.edits import (
    Edit,
    add_endpoint,
    both,
    change_node,
    change_report,
    drop_endpoint,
    drop_node,
    drop_report,
)
from tests.unit.verify.perfect import perfect

PUB, SUB = EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION
PLAN = build_plan(teleop(), environment={})
NOBODYS = add_endpoint(PUB, "", "/odometry", type="nav_msgs/msg/Odometry")


def line(edit: Edit, plan=PLAN) -> str:
    return missing(verify(plan, edit(perfect(plan)), stage=Stage.CONNECTED))


def test_nothing_is_missing_in_a_perfect_system():
    assert line(lambda seen: seen) == ""


def test_missing_things_are_named_with_what_they_are():
    edit = both(drop_node("/viewer"), drop_endpoint(PUB, "/robot/status"))
    assert line(edit) == ("missing: /viewer (node), /robot/status (publisher of /robot/camera)")


def test_what_is_there_but_wrong_comes_after_what_is_missing():
    edit = both(
        change_node("/viewer", state="unconfigured"),
        change_report(PUB, "/robot/status", matched=0),
        change_report(SUB, "/robot/status", matched=0),
    )
    assert line(edit) == (
        "missing: /robot/status: /robot/camera → /viewer (match);"
        " wrong: /viewer (state.wrong-state)"
    )


def test_a_report_is_waited_for_but_not_what_only_the_report_could_prove():
    assert line(drop_report("/viewer")) == "missing: /viewer (report)"


def test_an_unverifiable_finding_is_waited_for_only_where_it_blocks():
    edit = change_report(SUB, "/robot/status", qos=None)
    assert line(edit) == ""
    strict = dataclasses.replace(PLAN, policy=Policy(unverifiable_blocks=True))
    assert line(edit, strict) == "unknown: /robot/status (graph.qos-unverifiable)"


def test_an_endpoint_of_an_unknown_node_is_unknown_and_not_wrong():
    assert line(NOBODYS) == "unknown: /odometry (graph.unattributed-endpoint)"


def test_an_endpoint_of_an_unknown_node_is_not_named_while_a_declared_node_is_missing():
    """Discovery tells of an endpoint first and of its node a moment later."""
    edit = both(drop_node("/viewer"), NOBODYS)
    assert line(edit) == "missing: /viewer (node)"


def test_what_keeps_a_verdict_from_being_ok_is_named_although_the_gate_may_open():
    seen = change_report(SUB, "/robot/status", qos=None)(perfect(PLAN))
    verdict = verify(PLAN, seen, stage=Stage.CONNECTED)
    assert not_ok(verdict) == "unknown: /robot/status (graph.qos-unverifiable)"
    assert not_ok(verify(PLAN, perfect(PLAN), stage=Stage.CONNECTED)) == ""
    missing_node = verify(PLAN, drop_node("/viewer")(perfect(PLAN)), stage=Stage.CONNECTED)
    assert not_ok(missing_node) == missing(missing_node) != ""
