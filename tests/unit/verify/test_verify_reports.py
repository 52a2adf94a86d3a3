"""The verdict written down for people, for machines and for continuous integration."""

from __future__ import annotations

import functools
import json
import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import jsonschema
import msgspec
import pytest
from msgspec.structs import replace

from lifecycle import codec
from lifecycle.manifest.model import EndpointKind, UniqueHow
from lifecycle.network.nfe import (
    FlowTuple,
    InternetProtocol,
    NetworkFlowEndpoint,
    TransportProtocol,
    UniqueRequirement,
)
from lifecycle.plan.build import build_plan
from lifecycle.plan.model import Plan
from lifecycle.verify.observation import NodeConfiguration
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.report import render_text, to_github, to_json, to_junit, to_sarif
from lifecycle.verify.rules import RULES, rule
from lifecycle.verify.verdict import (
    NOT_JUDGED,
    Finding,
    FlowReport,
    RunEnd,
    Stage,
    ToleratedNode,
    Verdict,
)
from tests.builders import teleop
from tests.unit.verify.edits import (
    Edit,
    add_node,
    both,
    change_report,
    change_reported_qos,
    drop_node,
    unchanged,
)
from tests.unit.verify.lines import verify
from tests.unit.verify.perfect import perfect

SCHEMAS = Path(__file__).parents[3] / "schemas"
PUB, SUB = EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION
PLAN = build_plan(teleop(), environment={})


def after(edit: Edit) -> Verdict:
    return verify(PLAN, edit(perfect(PLAN)), stage=Stage.CONNECTED)


BAD = both(
    change_reported_qos(SUB, "/robot/status", depth=1),
    change_report(PUB, "/robot/battery", dscp=None),
)
NOT_DECLARED = add_node("/spy<&>\x07")


def schema(name: str) -> dict:
    return json.loads((SCHEMAS / name).read_text(encoding="utf-8"))


VIOLATED = Finding(
    rule="graph.qos-differs",
    outcome=Outcome.VIOLATED,
    subject="/a",
    expected="depth 10",
    observed="depth 1",
    message="cannot accept this",
    at="my robot:1.yaml:18:9",
    node="/one",
    endpoint=SUB,
    hint="correct it",
)
NOT_KNOWN = Finding(
    rule="flow.dscp-unverifiable",
    outcome=Outcome.UNVERIFIABLE,
    subject="/a → /b",
    expected="inactive",
    observed="unknown",
    message="cannot verify that",
)


WRITTEN = Verdict(
    verdict=Outcome.VIOLATED,
    blocking=True,
    findings=(VIOLATED, NOT_KNOWN),
    flows=(
        FlowReport(
            topic="/a",
            publisher="/one",
            subscription="/two",
            source=(),
            destination=(),
            unique=None,
            dscp=None,
            requirement=(
                UniqueRequirement.OPTIONALLY_REQUIRED,
                UniqueRequirement.STRICTLY_REQUIRED,
            ),
            demanded=UniqueHow.NOT,
            outcome=Outcome.UNVERIFIABLE,
            effective_transport="shm",
        ),
    ),
    tolerated=(
        ToleratedNode(node="/rviz2", because="tolerated_nodes: rviz*"),
        ToleratedNode(node="", because="undeclared_nodes: open"),
    ),
    run=RunEnd(reason="/one died", reached="active", exit_code=3, trusted="1 depth"),
)
"""A verdict that has everything."""


# --- text


def test_a_good_verdict_is_one_line_and_its_flows_with_the_tuples_that_carry_them():
    lines = render_text(after(unchanged)).splitlines()
    assert lines[:3] == ["verdict: ok (3 flows)", "", "flows"]
    pair, video, battery = (
        "/robot/camera → /viewer",
        "EF = DSCP 46 = TOS 184 (0xb8)",
        "CS1 = DSCP 8",
    )
    assert lines[3:] == [
        f"  /robot/video    {pair}  strongly unique  {video}  udpv4  ok",
        "    udp 0.0.0.0:40001 → 10.77.0.2:7020",
        f"  /robot/battery  {pair}  weakly unique    {battery} = TOS 32 (0x20)   udpv4  ok",
        "    udp 0.0.0.0:40002 → 10.77.0.2:7413",
        f"  /robot/status   {pair}  weakly unique    {'':29}  udpv4  ok",
        "    udp 0.0.0.0:40000 → 10.77.0.2:7413",
    ]


def with_first_flow(**changes: object) -> Verdict:
    verdict = after(unchanged)
    flow = replace(verdict.flows[0], **changes)
    return replace(verdict, flows=(flow,))


def test_an_ipv6_flow_shows_its_flow_label_or_that_the_sender_sets_none():
    udp6 = functools.partial(
        NetworkFlowEndpoint,
        transport_protocol=TransportProtocol.UDP,
        internet_protocol=InternetProtocol.IPV6,
    )
    ends: dict[str, Any] = {
        "source": (udp6(internet_address="fd00::1", transport_port=7411, flow_label=0xABC),),
        "destination": (udp6(internet_address="fd00::2", transport_port=7000),),
        "effective_transport": "udpv6",
    }
    text = render_text(with_first_flow(**ends))
    assert text.splitlines()[-1] == "    udp [fd00::1]:7411 → [fd00::2]:7000 flow_label 0x00abc"
    ends["source"] = (udp6(internet_address="::", transport_port=7411),)
    text = render_text(with_first_flow(**ends))
    assert text.splitlines()[-1] == "    udp [::]:7411 → [fd00::2]:7000 flow_label unset"


BAD_TEXT = """\
verdict: violated (1 violated, 1 unverifiable, 3 flows)

violated graph.qos-differs: /robot/status
  the subscription of /robot/status in /viewer has depth 1, and must have depth
  10
  at        robot.lifecycle.yaml:18:9
  to do     correct the profile in the manifest or in the node; look for an XML
            profile or a qos_overrides parameter

unverifiable flow.dscp-unverifiable: /robot/battery
  nothing shows that the sockets of the publisher of /robot/battery in
  /robot/camera carry CS1 = DSCP 8 = TOS 32 (0x20): it was not read back
  at        robot.lifecycle.yaml:12:9
  to do     only nodes in our host mark and read back; mark a foreign node's
            flow in the network
"""


def test_a_bad_verdict_says_what_was_expected_and_observed_where_and_what_to_do():
    assert render_text(after(BAD), flows=False, width=80) == BAD_TEXT


@pytest.mark.parametrize(("how", "columns"), [({}, 100), ({"width": 60}, 60), ({"width": 1}, 40)])
def test_sentences_are_wrapped_between_words_at_40_columns_at_least(how, columns):
    words, whole = ("x" * 20, "y" * (columns - 23)), "/" + "a-" * columns
    finding = replace(VIOLATED, message=" ".join((*words, whole, *words)) + "y")
    lines = render_text(replace(WRITTEN, findings=(finding,)), **how).splitlines()[3:7]
    assert lines == [f"  {' '.join(words)}", f"  {whole}", f"  {words[0]}", f"  {words[1]}y"]


def test_colour_comes_only_when_asked_for():
    assert "\x1b" not in render_text(after(BAD))
    red, yellow, green, reset = "\x1b[31m", "\x1b[33m", "\x1b[32m", "\x1b[0m"
    plain = render_text(after(BAD)).splitlines()
    assert plain[-2].split()[-2:] == ["udpv4", "ok"], "flows end with their outcome"
    in_colour = {
        plain[0]: f"{red}{plain[0]}{reset}",
        plain[2]: f"{red}violated{reset} graph.qos-differs: /robot/status",
        plain[8]: f"{yellow}unverifiable{reset} flow.dscp-unverifiable: /robot/battery",
        plain[-6]: plain[-6].removesuffix("ok") + f"{green}ok{reset}",
        plain[-4]: plain[-4].removesuffix("unverifiable") + f"{yellow}unverifiable{reset}",
        plain[-2]: plain[-2].removesuffix("ok") + f"{green}ok{reset}",
    }
    coloured = render_text(after(BAD), colour=True).splitlines()
    assert coloured == [in_colour.get(line, line) for line in plain]


def test_what_a_verdict_allows_and_how_its_run_ended_follow_what_it_finds():
    assert (
        render_text(WRITTEN)
        == """\
verdict: violated (1 violated, 1 unverifiable, 1 flow)

violated graph.qos-differs: /a
  cannot accept this
  at        my robot:1.yaml:18:9
  to do     correct it

unverifiable flow.dscp-unverifiable: /a → /b
  cannot verify that

tolerated: /rviz2, an unknown node

flows
  /a  /one → /two  uniqueness unknown  shm  unverifiable

ended after it was active, exit code 3: /one died; taken on trust: 1 depth
"""
    )


def test_the_first_line_counts_the_findings_of_each_outcome_and_the_flows():
    verdict = replace(
        WRITTEN,
        findings=(VIOLATED, VIOLATED, NOT_KNOWN, VIOLATED),
        flows=(*WRITTEN.flows, *WRITTEN.flows),
    )
    first = "verdict: violated (3 violated, 1 unverifiable, 2 flows)"
    assert render_text(verdict).splitlines()[0] == first


# --- JSON


def test_the_json_of_a_verdict_leaves_out_what_is_as_it_mostly_is():
    document = json.loads(to_json(WRITTEN))
    assert [*document] == ["verdict", "blocking", "findings", "flows", "tolerated", "run"]
    assert document["findings"][0]["rule"] == "graph.qos-differs"
    assert document["tolerated"][0] == {"node": "/rviz2", "because": "tolerated_nodes: rviz*"}
    assert json.loads(to_json(WRITTEN, indent=2)) == document
    jsonschema.Draft202012Validator(schema("verdict.v1.schema.json")).validate(document)


@pytest.mark.parametrize(
    ("name", "definition", "type_"),
    [
        ("verdict.v1.schema.json", "Finding", Finding),
        ("verdict.v1.schema.json", "FlowReport", FlowReport),
        ("verdict.v1.schema.json", "FlowTuple", FlowTuple),
        ("verdict.v1.schema.json", "RunEnd", RunEnd),
        ("node_configuration.v1.schema.json", "", NodeConfiguration),
    ],
)
def test_a_schema_names_exactly_the_fields_of_its_type(name: str, definition: str, type_: type):
    document = schema(name)
    properties = (document["$defs"][definition] if definition else document)["properties"]
    assert set(properties) == {each.name for each in msgspec.structs.fields(type_)}


def test_a_node_configuration_fits_its_schema_and_one_with_an_unknown_key_does_not():
    validator = jsonschema.Draft202012Validator(schema("node_configuration.v1.schema.json"))
    for configuration in perfect(PLAN).configurations:
        document = json.loads(codec.to_json(configuration))
        validator.validate(document)
        with pytest.raises(jsonschema.ValidationError):
            validator.validate({**document, "colour": "red"})


# --- the end of a run

UNJUDGED = replace(
    NOT_JUDGED,
    run=RunEnd(reason="interrupted; /talker is still configuring", reached=None, exit_code=130),
)


def test_the_last_line_of_a_run_says_why_it_ended_and_how_far_it_came():
    assert render_text(UNJUDGED) == (
        "verdict: unverifiable\n\n"
        "ended before it was connected, exit code 130: interrupted; /talker is still configuring\n"
    )
    for reached, place in (
        ("connected", "when connected, before it was verified"),
        ("verified", "when verified, before it was active"),
        ("active", "after it was active"),
    ):
        run = RunEnd(reason="done", reached=reached, exit_code=0)
        assert run.describe() == f"ended {place}, exit code 0: done"


def test_a_run_that_nobody_judged_is_no_success_in_junit_and_sarif():
    for each in (UNJUDGED, replace(UNJUDGED, run=None)):
        came = cases(each)
        assert (came.pop("run/end"), came.pop("manifest/the manifest is valid")) == (
            "failure",
            "passed",
        )
        assert set(came.values()) == {"skipped"}
    (run,) = json.loads(to_sarif(UNJUDGED))["runs"]
    assert [(each["ruleId"], each["level"]) for each in run["results"]] == [("run.end", "error")]
    assert run["invocations"] == [
        {
            "executionSuccessful": False,
            "exitCode": 130,
            "exitCodeDescription": UNJUDGED.run.describe(),
        }
    ]


# --- JUnit


def cases(verdict: Verdict, plan: Plan | None = PLAN, *, strict: bool = False) -> dict[str, str]:
    """What each test case comes to, by its name."""
    words = {"failure", "skipped"}
    root = ET.fromstring(to_junit(verdict, plan, strict=strict))
    found = [
        (f"{each.get('classname')}/{each.get('name')}", words & {child.tag for child in each})
        for each in root.iter("testcase")
    ]
    assert len(dict(found)) == len(found)
    return {name: "".join(tags) or "passed" for name, tags in found}


INVALID = replace(
    UNJUDGED,
    verdict=Outcome.VIOLATED,
    findings=(
        Finding(
            rule="manifest.unknown-key",
            outcome=Outcome.VIOLATED,
            subject="nodes.camera.nmae",
            expected="",
            observed="",
            message="cannot use key 'nmae'",
            at="robot.lifecycle.yaml:4:5",
        ),
    ),
)


def test_test_cases_have_the_same_names_whatever_the_outcome():
    names = list(cases(after(unchanged)))
    for edit in (NOT_DECLARED, change_report(PUB, "/robot/battery", dscp=None)):
        assert list(cases(after(edit))) == names
    assert list(cases(UNJUDGED)) == names
    assert list(cases(INVALID, plan=None)) == names
    assert sorted(names) == sorted(
        [
            "manifest/the manifest is valid",
            *(f"{each.id}/{each.meaning}" for each in RULES),
            "run/end",
        ]
    )


def test_an_invalid_manifest_fails_where_it_is_wrong():
    root = ET.fromstring(to_junit(INVALID, None))
    case = next(root.iter("testcase"))
    assert case.get("classname") == "manifest"
    assert (case.get("file"), case.get("line")) == ("robot.lifecycle.yaml", "4")
    assert case.find("failure").get("message") == "cannot use key 'nmae'"
    (result,) = json.loads(to_sarif(INVALID))["runs"][0]["results"]
    assert (result["ruleId"], result["level"]) == ("manifest.unknown-key", "error")
    assert "ruleIndex" not in result
    document = json.loads(to_json(INVALID))
    jsonschema.Draft202012Validator(schema("verdict.v1.schema.json")).validate(document)
    assert document["judged"] is False


def test_what_may_be_unverifiable_neither_fails_nor_skips_a_test():
    unverifiable = after(change_report(PUB, "/robot/battery", dscp=None))
    assert unverifiable.verdict is Outcome.UNVERIFIABLE
    assert set(cases(unverifiable).values()) == {"passed"}
    assert "it was not read back" in to_junit(unverifiable, PLAN)
    failed = [name for name, came in cases(unverifiable, strict=True).items() if came == "failure"]
    assert [each.partition("/")[0] for each in failed] == ["flow.dscp-unverifiable"]
    policy = replace(PLAN.policy, unverifiable="block")
    blocking = replace(PLAN, policy=policy)
    assert list(cases(unverifiable, blocking).values()).count("failure") == 1
    trusting = replace(PLAN, policy=replace(policy, trust=("flow.dscp-unverifiable",)))
    assert "failure" not in cases(unverifiable, trusting, strict=True).values()


@pytest.mark.parametrize(
    ("rule", "refuses"),
    [
        ("graph.qos-unverifiable", (True, True)),
        ("flow.dscp-not-applied", (False, True)),
        ("manifest.no-rule-of-the-system", (True, True)),
    ],
)
def test_what_may_not_block_is_refused_by_who_is_strict_alone(
    rule: str, refuses: tuple[bool, bool]
):
    found = replace(VIOLATED, rule=rule, outcome=Outcome.UNVERIFIABLE)
    verdict = replace(WRITTEN, findings=(found,), run=None)
    policy = replace(PLAN.policy, unverifiable="block")
    blocking = replace(PLAN, policy=policy)
    came = tuple(
        "failure" in cases(verdict, blocking, strict=strict).values() for strict in (False, True)
    )
    assert came == refuses


def test_what_refuses_nothing_is_placed_at_the_first_declaration():
    first = replace(VIOLATED, outcome=Outcome.UNVERIFIABLE)
    found = (first, replace(first, at="other.yaml:2:3"))
    root = ET.fromstring(to_junit(replace(WRITTEN, findings=found, run=None), PLAN))
    (case,) = (each for each in root.iter("testcase") if each.get("file"))
    assert (case.get("file"), case.get("line")) == ("my robot:1.yaml", "18")


def test_what_was_judged_before_a_run_failed_is_not_skipped():
    run = RunEnd(reason="failed: /camera (run.process-died)", reached="active", exit_code=6)
    came = cases(replace(after(unchanged), run=run))
    assert {name for name, each in came.items() if each != "passed"} == {"run/end"}


def test_junit_escapes_what_xml_cannot_hold():
    text = to_junit(after(NOT_DECLARED), PLAN)
    assert r"/spy<&>\x07" in "".join(ET.fromstring(text).itertext())


def test_the_junit_of_findings_and_flows_is_spelled_so():
    done = RunEnd(reason="done", reached="active", exit_code=0)
    text = to_junit(replace(WRITTEN, findings=(VIOLATED, VIOLATED), run=done), PLAN)
    passed = re.compile(r'    <testcase classname="(?!run")[^"]*" name="[^"]*" />\n')
    count = f'tests="{len(RULES) + 2}" failures="1" skipped="0"'
    names = f'classname="graph.qos-differs" name="{rule("graph.qos-differs").meaning}"'
    described = """violated graph.qos-differs: /a
  cannot accept this
  at        my robot:1.yaml:18:9
  to do     correct it
"""
    assert (
        passed.sub("", text)
        == f"""\
<?xml version="1.0" encoding="UTF-8"?>
<testsuites {count}>
  <testsuite name="lifecycle verify robot" {count}>
    <testcase {names} file="my robot:1.yaml" line="18">
      <failure message="cannot accept this (and 1 more)">{described}
{described}</failure>
    </testcase>
    <testcase classname="run" name="end">
      <system-out>ended after it was active, exit code 0: done
</system-out>
    </testcase>
    <system-out>/a: /one → /two: unverifiable
</system-out>
  </testsuite>
</testsuites>
"""
    )


# --- SARIF


def test_the_sarif_of_a_verdict_is_spelled_so():
    text = to_sarif(WRITTEN)
    assert text.startswith('{\n  "$schema": ')
    assert text.endswith("\n}\n")
    assert "/a → /b" in text
    log = json.loads(text)
    rules = log["runs"][0]["tool"]["driver"].pop("rules")
    assert rules == [
        {
            "id": each.id,
            "shortDescription": {"text": each.meaning},
            "help": {"text": each.fix},
            "defaultConfiguration": {
                "level": "error" if each.outcomes[0] is Outcome.VIOLATED else "warning"
            },
        }
        for each in RULES
    ]
    (run,) = log["runs"]
    assert (log["version"], run["tool"]["driver"]["name"]) == ("2.1.0", "lifecycle")
    violated, unverifiable = run["results"]
    assert violated == {
        "ruleId": "graph.qos-differs",
        "ruleIndex": [each.id for each in RULES].index("graph.qos-differs"),
        "level": "error",
        "message": {"text": "cannot accept this; correct it"},
        "locations": [
            {
                "logicalLocations": [{"fullyQualifiedName": "/a", "kind": "resource"}],
                "physicalLocation": {
                    "artifactLocation": {"uri": "my%20robot%3A1.yaml"},
                    "region": {"startLine": 18, "startColumn": 9},
                },
            }
        ],
        "properties": {"outcome": "violated", "expected": "depth 10", "observed": "depth 1"},
    }
    assert (unverifiable["level"], unverifiable["ruleId"]) == ("warning", "flow.dscp-unverifiable")
    assert run["properties"] == {"verdict": "violated"}


def test_sarif_blames_the_end_of_a_run_only_where_no_finding_is_an_error():
    def results(**changes: object) -> list[dict]:
        (run,) = json.loads(to_sarif(replace(WRITTEN, **changes)))["runs"]
        return run["results"]

    assert [each["ruleId"] for each in results(findings=(NOT_KNOWN,))] == [
        "flow.dscp-unverifiable",
        "run.end",
    ]
    assert results(findings=()) == [
        {
            "ruleId": "run.end",
            "level": "error",
            "message": {
                "text": "ended after it was active, exit code 3: /one died; taken on trust: 1 depth"
            },
        }
    ]
    assert results(findings=(), run=None) == []
    done = RunEnd(reason="done", reached="active", exit_code=0)
    assert results(findings=(), run=done) == []
    (run,) = json.loads(to_sarif(replace(WRITTEN, run=done)))["runs"]
    assert run["invocations"][0]["executionSuccessful"] is True
    (run,) = json.loads(to_sarif(replace(WRITTEN, run=None)))["runs"]
    assert "invocations" not in run


@pytest.mark.parametrize("strict", [False, True])
def test_a_verdict_on_github_is_its_text_and_an_annotation_for_each_finding(*, strict: bool):
    verdict = after(both(drop_node("/robot/camera"), drop_node("/viewer")))
    first, *others = verdict.findings
    assert others
    verdict = replace(verdict, findings=(replace(first, outcome=Outcome.UNVERIFIABLE), *others))
    outcomes = [each.outcome for each in verdict.findings]
    text = render_text(verdict)
    found = to_github(verdict, strict=strict)
    assert found.startswith(text)
    lines = found.removeprefix(text).splitlines()
    assert len(lines) == len(outcomes)
    for line, outcome in zip(lines, outcomes, strict=True):
        is_error = strict or outcome is Outcome.VIOLATED
        assert line.startswith("::error " if is_error else "::warning ")
        assert "file=" in line
