"""The verdict written down for people, for machines and for continuous integration."""

from __future__ import annotations

import dataclasses
import functools
import json
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import jsonschema
import pytest

from lifecycle import codec
from lifecycle.manifest.model import EndpointKind
from lifecycle.network.flow import FlowTuple
from lifecycle.network.nfe import InternetProtocol, NetworkFlowEndpoint, TransportProtocol
from lifecycle.plan import build_plan
from lifecycle.verify import (
    RULES,
    Finding,
    FlowReport,
    NodeConfiguration,
    Outcome,
    RunEnd,
    Stage,
    Verdict,
    render_text,
    to_json,
    to_junit,
    to_sarif,
    verify,
)
from tests.unit.plan.samples import teleop
from tests.unit.verify.edits import (
    Edit,
    add_node,
    both,
    change_report,
    change_reported_qos,
    drop_endpoint,
    drop_node,
    drop_report,
)
from tests.unit.verify.perfect import perfect

SCHEMAS = Path(__file__).parents[3] / "schemas"
PUB, SUB = EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION
PLAN = build_plan(teleop(), environment={})


def after(edit: Edit) -> Verdict:
    return verify(PLAN, edit(perfect(PLAN)), stage=Stage.CONNECTED)


def perfectly(seen):
    return seen


BAD = both(
    change_reported_qos(SUB, "/robot/status", depth=1),
    change_report(PUB, "/robot/battery", dscp=None),
)
NOT_DECLARED = add_node("/spy<&>\x07")
EDITS = {
    "ok": perfectly,
    "bad": BAD,
    "undeclared": NOT_DECLARED,
    "gone": both(drop_node("/viewer"), drop_report("/robot/camera")),
    "endpoint gone": drop_endpoint(PUB, "/robot/video"),
}


def schema(name: str) -> dict:
    return json.loads((SCHEMAS / name).read_text(encoding="utf-8"))


# --- text


def test_a_good_verdict_is_one_line_and_its_flows_with_the_tuples_that_carry_them():
    lines = render_text(after(perfectly)).splitlines()
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
    verdict = after(perfectly)
    flow = dataclasses.replace(verdict.flows[0], **changes)
    return dataclasses.replace(verdict, flows=(flow,))


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


def test_a_flow_that_shared_memory_carries_shows_no_tuple_that_does_not_carry_it():
    assert render_text(with_first_flow(effective_transport="shm")).endswith("  shm  ok\n")


BAD_TEXT = """\
verdict: violated (1 violated, 1 unverifiable, 3 flows)

violated graph.qos-differs: /robot/status
  cannot accept the subscription of /robot/status in /viewer: depth is declared
  10 and is 1
  expected  depth 10
  observed  depth 1
  at        robot.lifecycle.yaml:18:9
  to do     correct the profile in the manifest or in the node; look for an XML
            profile or a qos_overrides parameter

unverifiable flow.dscp-unverifiable: /robot/battery
  cannot verify the DSCP of the publisher of /robot/battery in /robot/camera:
  nobody read it back
  expected  CS1 = DSCP 8 = TOS 32 (0x20)
  observed  not read back
  at        robot.lifecycle.yaml:12:9
  to do     only nodes in our host mark and read back; mark a foreign node's
            flow in the network
"""


def test_a_bad_verdict_says_what_was_expected_and_observed_where_and_what_to_do():
    assert render_text(after(BAD), flows=False, width=80) == BAD_TEXT


def test_colour_comes_only_when_asked_for():
    assert "\x1b" not in render_text(after(BAD))
    assert "\x1b[31mviolated\x1b[0m graph.qos-differs" in render_text(after(BAD), colour=True)


def test_sentences_wrap_at_the_width():
    lines = render_text(after(BAD), width=60, flows=False).splitlines()
    assert max(len(line) for line in lines) <= 60


# --- JSON


@pytest.mark.parametrize("edit", EDITS)
def test_json_has_exactly_verdict_findings_and_flows_and_fits_the_schema(edit: str):
    document = json.loads(to_json(after(EDITS[edit])))
    assert list(document) == ["verdict", "findings", "flows"]
    jsonschema.Draft202012Validator(schema("verdict.v1.schema.json")).validate(document)


def test_a_finding_in_json_has_every_fact():
    (finding,) = json.loads(to_json(after(change_reported_qos(SUB, "/robot/status", depth=1))))[
        "findings"
    ]
    hint = finding.pop("hint")
    assert hint.startswith("correct the profile")
    assert finding == {
        "rule": "graph.qos-differs",
        "outcome": "violated",
        "subject": "/robot/status",
        "expected": "depth 10",
        "observed": "depth 1",
        "message": "cannot accept the subscription of /robot/status in /viewer:"
        " depth is declared 10 and is 1",
        "at": "robot.lifecycle.yaml:18:9",
        "node": "/viewer",
        "endpoint": "subscriptions",
    }


def test_json_can_be_indented_for_people():
    assert to_json(after(perfectly), indent=2).startswith('{\n  "verdict": "ok",\n')


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
    assert set(properties) == {field.name for field in dataclasses.fields(type_)}


def test_a_node_configuration_fits_its_schema_and_one_with_an_unknown_key_does_not():
    validator = jsonschema.Draft202012Validator(schema("node_configuration.v1.schema.json"))
    for configuration in perfect(PLAN).configurations:
        document = json.loads(codec.to_json(configuration))
        validator.validate(document)
        with pytest.raises(jsonschema.ValidationError):
            validator.validate({**document, "colour": "red"})


@pytest.mark.parametrize("path", sorted(SCHEMAS.glob("*.json")), ids=lambda path: path.name)
def test_every_shipped_schema_is_a_schema(path: Path):
    jsonschema.Draft202012Validator.check_schema(json.loads(path.read_text(encoding="utf-8")))


# --- the end of a run

UNJUDGED = Verdict(
    verdict=Outcome.UNVERIFIABLE,
    blocking=True,
    findings=(),
    flows=(),
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


def test_the_json_of_a_run_has_its_reason_and_fits_the_schema():
    document = json.loads(to_json(UNJUDGED))
    jsonschema.Draft202012Validator(schema("verdict.v1.schema.json")).validate(document)
    assert document["run"] == {
        "reason": "interrupted; /talker is still configuring",
        "reached": None,
        "exit_code": 130,
    }


def test_a_run_that_nobody_judged_is_no_success_in_junit_and_sarif():
    root = ET.fromstring(to_junit(UNJUDGED, PLAN))
    assert root.get("failures") == "1"
    (case,) = (each for each in root.iter("testcase") if each.find("failure") is not None)
    assert (case.get("classname"), case.get("name")) == ("run", "end")
    (run,) = json.loads(to_sarif(UNJUDGED))["runs"]
    assert run["invocations"] == [
        {
            "executionSuccessful": False,
            "exitCode": 130,
            "exitCodeDescription": UNJUDGED.run.describe(),
        }
    ]


# --- JUnit


@pytest.mark.parametrize("edit", EDITS)
def test_junit_counts_what_it_holds(edit: str):
    verdict = after(EDITS[edit])
    root = ET.fromstring(to_junit(verdict, PLAN))
    assert root.get("name") == "lifecycle verify robot"
    for element in (root, *root.findall("testsuite")):
        assert element.get("tests") == str(len(element.findall(".//testcase")))
        assert element.get("failures") == str(len(element.findall(".//failure")))
        assert element.get("skipped") == str(len(element.findall(".//skipped")))
    of_rules = [each for each in root.iter("testcase") if each.get("classname") != "flow"]
    failed = [each for each in of_rules if each.find("failure") is not None]
    assert len(failed) == sum(each.outcome is Outcome.VIOLATED for each in verdict.findings)
    found = {each.rule for each in verdict.findings}
    passed = {each.get("classname") for each in of_rules if len(each) == 0}
    assert passed == {rule.id for rule in RULES} - found


def test_junit_puts_a_failure_at_the_declaration():
    root = ET.fromstring(to_junit(after(BAD), PLAN))
    (case,) = (
        each for each in root.iter("testcase") if each.get("classname") == "graph.qos-differs"
    )
    assert (case.get("name"), case.get("file"), case.get("line")) == (
        "/robot/status",
        "robot.lifecycle.yaml",
        "18",
    )
    assert case.find("failure").get("message") == (
        "cannot accept the subscription of /robot/status in /viewer: depth is declared 10 and is 1"
    )


def test_junit_replaces_what_xml_cannot_hold():
    text = to_junit(after(NOT_DECLARED), PLAN)
    names = [each.get("name") for each in ET.fromstring(text).iter("testcase")]
    assert "/spy<&>\ufffd" in names


# --- SARIF


def test_sarif_points_at_the_declaration_and_describes_every_rule():
    log = json.loads(to_sarif(after(BAD)))
    (run,) = log["runs"]
    assert log["version"] == "2.1.0"
    assert [each["id"] for each in run["tool"]["driver"]["rules"]] == [each.id for each in RULES]
    violated, unverifiable = run["results"]
    assert (violated["level"], unverifiable["level"]) == ("error", "warning")
    assert RULES[violated["ruleIndex"]].id == violated["ruleId"] == "graph.qos-differs"
    (location,) = violated["locations"]
    assert location["physicalLocation"] == {
        "artifactLocation": {"uri": "robot.lifecycle.yaml"},
        "region": {"startLine": 18, "startColumn": 9},
    }
    assert location["logicalLocations"][0]["fullyQualifiedName"] == "/robot/status"


def test_sarif_of_something_undeclared_has_no_place_in_a_file():
    (result,) = json.loads(to_sarif(after(NOT_DECLARED)))["runs"][0]["results"]
    assert list(result["locations"][0]) == ["logicalLocations"]
