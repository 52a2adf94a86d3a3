"""The verdict as JUnit XML, for continuous integration. Pure.

Owns: one test suite per rule family, one test case per rule that holds and per finding. Violated is
a failure, unverifiable is skipped: it did not fail, and it did not pass.
"""

from __future__ import annotations

import re
from xml.etree import ElementTree as ET

from lifecycle.plan.model import Plan
from lifecycle.verify.rules import RULES
from lifecycle.verify.rules.catalogue import Rule
from lifecycle.verify.verdict import Finding, FlowReport, Outcome, RunEnd, Verdict

_NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that XML 1.0 §2.2 cannot hold, not even escaped."""


def to_junit(verdict: Verdict, plan: Plan) -> str:
    """Write JUnit XML; a rule without a finding is a passed test case, so is a flow that is ok."""
    root = ET.Element("testsuites", name=_legal(f"lifecycle verify {plan.system}"))
    families: dict[str, list[Rule]] = {}
    for rule in RULES:
        families.setdefault(rule.id.partition(".")[0], []).append(rule)
    total = [0, 0, 0]
    for family, rules in families.items():
        suite = ET.SubElement(root, "testsuite", name=family)
        for rule in rules:
            findings = [each for each in verdict.findings if each.rule == rule.id]
            for finding in findings:
                _finding_case(suite, finding)
            if not findings:
                ET.SubElement(suite, "testcase", classname=rule.id, name=_legal(rule.meaning))
        if family == "run" and verdict.run is not None:
            _end_case(suite, verdict.run)
        _count(suite, total)
    suite = ET.SubElement(root, "testsuite", name="flows")
    for flow in verdict.flows:
        _flow_case(suite, flow)
    _count(suite, total)
    for name, value in zip(("tests", "failures", "skipped"), total, strict=True):
        root.set(name, str(value))
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _end_case(suite: ET.Element, run: RunEnd) -> None:
    """An interrupted run, whose system nobody judged, must not read as one without fault."""
    case = ET.SubElement(suite, "testcase", classname="run", name="end")
    outcome = Outcome.OK if run.exit_code == 0 else Outcome.VIOLATED
    _result(case, outcome, run.reason, run.describe())


def _finding_case(suite: ET.Element, finding: Finding) -> None:
    case = ET.SubElement(suite, "testcase", classname=finding.rule, name=_legal(finding.subject))
    if finding.at:
        file, line, _ = finding.at.rsplit(":", 2)
        case.set("file", _legal(file))
        case.set("line", line)
    _result(
        case,
        finding.outcome,
        finding.message,
        f"expected: {finding.expected}\nobserved: {finding.observed}\nat: {finding.at}\n"
        f"to do: {finding.hint}\n",
    )


def _flow_case(suite: ET.Element, flow: FlowReport) -> None:
    case = ET.SubElement(
        suite,
        "testcase",
        classname="flow",
        name=_legal(f"{flow.topic}: {flow.publisher} → {flow.subscription}"),
    )
    if flow.outcome is not Outcome.OK:
        _result(case, flow.outcome, f"flow is {flow.outcome.value}", "see the findings on it\n")


def _result(case: ET.Element, outcome: Outcome, message: str, text: str) -> None:
    tag = "failure" if outcome is Outcome.VIOLATED else "skipped"
    element = ET.SubElement(case, tag, message=_legal(message))
    element.text = _legal(text)


def _count(suite: ET.Element, total: list[int]) -> None:
    """Fill in a suite's counts and add them to the total."""
    counts = (
        len(suite.findall("testcase")),
        len(suite.findall("testcase/failure")),
        len(suite.findall("testcase/skipped")),
    )
    for index, (name, value) in enumerate(
        zip(("tests", "failures", "skipped"), counts, strict=True)
    ):
        suite.set(name, str(value))
        total[index] += value


def _legal(text: str) -> str:
    return _NOT_XML.sub("\ufffd", text)
