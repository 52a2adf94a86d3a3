"""The verdict as JUnit XML, for continuous integration. Pure.

Owns: which test cases there are, and what each comes to. Their names and number are always the
same, so that reports can be compared case by case: one for the manifest, one for each rule, one for
the end of the run. What refuses the system is a failure. What could not be verified and was allowed
is in the case's system-out, as flows are in their suite's; a case is skipped only where nothing was
judged, and then the end of the run fails.
"""

from __future__ import annotations

from collections.abc import Iterable
from xml.etree import ElementTree as ET

from lifecycle.plan.model import Plan
from lifecycle.printable import lines, one_line
from lifecycle.verify.rules import RULES
from lifecycle.verify.rules.catalogue import Rule
from lifecycle.verify.verdict import Finding, FlowReport, Outcome, RunEnd, Verdict

_IDS = frozenset(each.id for each in RULES)


def to_junit(verdict: Verdict, plan: Plan | None, *, strict: bool = False) -> str:
    """Write JUnit XML.

    Args:
        verdict: what the cases come to.
        plan: None where there is none, because the manifest cannot be used.
        strict: what cannot be verified refuses the system, whatever its policy says.
    """
    name = f"lifecycle verify {plan.system}" if plan else "lifecycle verify"
    root = ET.Element("testsuites", name=_legal(name))
    writer = _Cases(verdict, plan, strict=strict)
    suite = ET.SubElement(root, "testsuite", name="manifest")
    writer.of_manifest(suite)
    families: dict[str, list[Rule]] = {}
    for rule in RULES:
        families.setdefault(rule.id.partition(".")[0], []).append(rule)
    for family, rules in families.items():
        suite = ET.SubElement(root, "testsuite", name=family)
        for rule in rules:
            writer.of_rule(suite, rule)
        if family == "run":
            writer.of_end(suite)
        if family == "flow" and verdict.flows:
            _note(suite, "".join(f"{_flow(each)}\n" for each in verdict.flows))
    total = [0, 0, 0]
    for suite in root:
        _count(suite, total)
    for key, value in zip(("tests", "failures", "skipped"), total, strict=True):
        root.set(key, str(value))
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


class _Cases:
    """Writes the cases of one verdict."""

    def __init__(self, verdict: Verdict, plan: Plan | None, *, strict: bool) -> None:
        self._verdict = verdict
        self._blocks = strict or (plan is not None and plan.policy.unverifiable_blocks)
        self._strict = strict
        self._may_block = {each.id: each.may_block for each in RULES}

    def of_manifest(self, suite: ET.Element) -> None:
        """Hold what is wrong with the manifest itself: no rule of the running system."""
        case = ET.SubElement(suite, "testcase", classname="manifest", name="the manifest is valid")
        self._findings(case, [each for each in self._verdict.findings if each.rule not in _IDS])

    def of_rule(self, suite: ET.Element, rule: Rule) -> None:
        """Hold all findings of one rule."""
        case = ET.SubElement(suite, "testcase", classname=rule.id, name=_legal(rule.meaning))
        findings = [each for each in self._verdict.findings if each.rule == rule.id]
        self._findings(case, findings)
        if not findings and not self._verdict.judged:
            _not_judged(case)

    def of_end(self, suite: ET.Element) -> None:
        """Fail where the run was no success: one whose system nobody judged must not read well."""
        case = ET.SubElement(suite, "testcase", classname="run", name="end")
        run = self._verdict.run
        if run is None and self._verdict.judged:
            return
        run = run or RunEnd(reason="nothing was judged", reached=None, exit_code=1)
        if run.exit_code == 0:
            _note(case, run.describe() + "\n")
        else:
            _failure(case, run.reason, run.describe() + "\n")

    def _findings(self, case: ET.Element, findings: list[Finding]) -> None:
        if not findings:
            return
        bad = [each for each in findings if self._refuses(each)]
        for first in bad[:1] or findings[:1]:
            if first.at:
                file, line, _ = first.at.rsplit(":", 2)
                case.set("file", _legal(file))
                case.set("line", line)
        if bad:
            more = f" (and {len(bad) - 1} more)" if len(bad) > 1 else ""
            _failure(case, bad[0].message + more, _described(bad))
        allowed = [each for each in findings if each not in bad]
        if allowed:
            _note(case, _described(allowed))

    def _refuses(self, finding: Finding) -> bool:
        """Whether a finding keeps the gate closed."""
        if finding.outcome is Outcome.UNVERIFIABLE:
            return self._blocks and (self._strict or self._may_block.get(finding.rule, True))
        return finding.outcome is Outcome.VIOLATED


def _described(findings: Iterable[Finding]) -> str:
    return "\n".join(
        f"{each.outcome.value} {each.rule}: {one_line(each.subject)}\n{one_line(each.message)}\n"
        f"expected: {one_line(each.expected)}\nobserved: {one_line(each.observed)}\n"
        f"at: {one_line(each.at)}\nto do: {one_line(each.hint)}\n"
        for each in findings
    )


def _flow(flow: FlowReport) -> str:
    return one_line(f"{flow.topic}: {flow.publisher} → {flow.subscription}: {flow.outcome.value}")


def _failure(case: ET.Element, message: str, text: str) -> None:
    ET.SubElement(case, "failure", message=_legal(message)).text = _legal(text)


def _note(place: ET.Element, text: str) -> None:
    ET.SubElement(place, "system-out").text = _legal(text)


def _not_judged(case: ET.Element) -> None:
    ET.SubElement(case, "skipped", message="not judged; see the end of the run")


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
    return lines(text)
