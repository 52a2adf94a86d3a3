"""The one line that a passed deadline says."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import EndpointKind, Policy
from lifecycle.plan.build import build_plan
from lifecycle.verify.judge import missing, not_ok, taken_on_trust
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules import RULES
from lifecycle.verify.verdict import Finding, Stage, Verdict
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


def test_everything_that_is_missing_wrong_or_unknown_is_named_once():
    edit = both(
        *(change_node(name, state="active", count=2) for name in ("/robot/camera", "/viewer")),
        drop_endpoint(PUB, "/robot/status"),
        drop_endpoint(PUB, "/robot/battery"),
        NOBODYS,
        NOBODYS,
        add_endpoint(PUB, "", "/news"),
    )
    assert line(edit) == (
        "missing: /robot/battery (publisher of /robot/camera), /robot/status (publisher of"
        " /robot/camera); wrong: /robot/camera (graph.duplicate-node), /viewer"
        " (graph.duplicate-node), /robot/camera (state.wrong-state), /viewer (state.wrong-state);"
        " unknown: /news (graph.unattributed-endpoint), /odometry (graph.unattributed-endpoint)"
    )


def test_a_report_is_waited_for_but_not_what_only_the_report_could_prove():
    assert line(drop_report("/viewer")) == "missing: /viewer (report)"
    assert line(change_report(SUB, "/robot/video", nfes=None)) == (
        "unknown: /robot/video (flow.unverifiable),"
        " /robot/video: /robot/camera → /viewer (flow.unverifiable)"
    )


def test_an_unverifiable_finding_is_waited_for_only_where_it_blocks():
    edit = change_report(SUB, "/robot/status", qos=None)
    assert line(edit) == ""
    strict = replace(PLAN, policy=Policy(unverifiable="block"))
    assert line(edit, strict) == "unknown: /viewer (graph.qos-unverifiable)"


def test_an_endpoint_of_an_unknown_node_is_not_named_while_a_declared_node_is_missing():
    """Discovery tells of an endpoint first and of its node a moment later."""
    edit = both(drop_node("/viewer"), NOBODYS)
    assert line(edit) == "missing: /viewer (node)"


def test_what_keeps_a_verdict_from_being_ok_is_named_although_the_gate_may_open():
    seen = change_report(SUB, "/robot/status", qos=None)(perfect(PLAN))
    verdict = verify(PLAN, seen, stage=Stage.CONNECTED)
    assert not_ok(verdict) == "unknown: /viewer (graph.qos-unverifiable)"
    assert not_ok(verify(PLAN, perfect(PLAN), stage=Stage.CONNECTED)) == ""
    missing_node = verify(PLAN, drop_node("/viewer")(perfect(PLAN)), stage=Stage.CONNECTED)
    assert not_ok(missing_node) == missing(missing_node) != ""


def unverifiable(rule: str, subject: str, expected: str = "") -> Finding:
    return Finding(
        rule=rule,
        outcome=Outcome.UNVERIFIABLE,
        subject=subject,
        expected=expected,
        observed="",
        message="",
    )


def trusted(*findings: Finding) -> str:
    verdict = Outcome.UNVERIFIABLE if findings else Outcome.OK
    return taken_on_trust(Verdict(verdict=verdict, blocking=False, findings=findings, flows=()))


@pytest.mark.parametrize(
    ("count", "words"),
    [(1, "/0"), (2, "/0, /1"), (3, "/0, /1 and 1 more")],
)
def test_two_subjects_of_a_rule_are_named_and_the_others_counted(count, words):
    found = (unverifiable("graph.missing-node", f"/{each}") for each in range(count))
    assert trusted(*found) == f"{words} (graph.missing-node)"


@pytest.mark.parametrize(("count", "more"), [(4, ""), (5, "; and 1 more rules")])
def test_four_rules_are_named_and_the_others_counted(count, more):
    ids = [each.id for each in RULES[:count]]
    named = "; ".join(f"/{each} ({each})" for each in ids[:4])
    assert trusted(*(unverifiable(each, f"/{each}") for each in ids)) == named + more


@pytest.mark.parametrize(("length", "cut"), [(479, False), (480, True), (900, True)])
def test_what_is_taken_on_trust_is_one_line_of_at_most_500_characters(length, cut):
    line = "x" * length + " (graph.missing-node)"
    assert trusted(unverifiable("graph.missing-node", "x" * length)) == (
        line[:499] + "…" if cut else line
    )
