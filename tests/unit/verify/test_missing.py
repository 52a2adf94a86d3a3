"""The one line that a passed deadline says."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import EndpointKind, Policy
from lifecycle.plan.build import build_plan
from lifecycle.verify.judge import missing, not_ok, summary, taken_on_trust
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules.nodes import MISSING_NODE
from lifecycle.verify.verdict import Stage
from tests.builders import teleop
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
from tests.unit.verify.lines import verify
from tests.unit.verify.perfect import perfect

PUB, SUB = EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION
PLAN = build_plan(teleop(), environment={})
NOBODYS = add_endpoint(PUB, "", "/odometry", type="nav_msgs/msg/Odometry")


def line(edit: Edit, plan=PLAN) -> str:
    return missing(verify(plan, edit(perfect(plan)), stage=Stage.CONNECTED))


def test_what_keeps_the_gate_closed_is_named_by_rule_two_subjects_of_each():
    edit = both(
        *(change_node(name, state="active", count=2) for name in ("/robot/camera", "/viewer")),
        *(drop_endpoint(PUB, name) for name in ("/robot/status", "/robot/battery", "/robot/video")),
        NOBODYS,
    )
    assert line(edit) == (
        "/robot/camera, /viewer (graph.duplicate-node); /robot/video, /robot/battery and 1 more"
        " (graph.missing-endpoint); /odometry (graph.unattributed-endpoint);"
        " /robot/video: /robot/camera → /viewer (graph.unmatched-link); and 1 more rules"
    )


def test_a_report_is_waited_for_but_not_what_only_the_report_could_prove():
    assert line(drop_report("/viewer")) == "/viewer (config.missing-report)"


def test_an_unverifiable_finding_is_waited_for_only_where_it_blocks():
    edit = change_report(SUB, "/robot/status", qos=None)
    assert line(edit) == ""
    strict = replace(PLAN, policy=Policy(unverifiable="block"))
    assert line(edit, strict) == "/viewer (graph.qos-unverifiable)"
    may_open = verify(PLAN, edit(perfect(PLAN)), stage=Stage.CONNECTED)
    assert not_ok(may_open) == taken_on_trust(may_open) == "/viewer (graph.qos-unverifiable)"


def test_an_endpoint_of_an_unknown_node_is_not_named_while_a_declared_node_is_missing():
    """Discovery tells of an endpoint first and of its node a moment later."""
    assert line(both(drop_node("/viewer"), NOBODYS)) == "/viewer (graph.missing-node)"


@pytest.mark.parametrize(("length", "cut"), [(479, False), (480, True), (900, True)])
def test_a_summary_is_one_line_of_at_most_500_characters(length, cut):
    found = MISSING_NODE.finding(
        subject="x" * length, outcome=Outcome.VIOLATED, expected="", observed=""
    )
    whole = "x" * length + " (graph.missing-node)"
    assert summary([found]) == (whole[:499] + "…" if cut else whole)
