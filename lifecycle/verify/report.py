"""Verification reports of a verdict: text, JUnit XML, SARIF 2.1.0, JSON and GitHub's annotations.

JUnit, for continuous integration: a case for each finding and one for the end of the run. What
refuses the system is a failure. What could not be verified and was allowed is in the case's
system-out, as flows are in their suite's; where nothing was judged, the end of the run fails.

SARIF, for editors and code scanning (OASIS SARIF 2.1.0): violated is an error, unverifiable a
warning; a finding points at the declaration in the manifest. A run that was no success has at least
one error; its rule is `run.end` where no finding is to blame. Pure.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

import msgspec
from msgspec.structs import replace

from lifecycle import codec
from lifecycle.ci_formats import Case, Json, Problem, github, junit, sarif
from lifecycle.manifest.model import UniqueHow
from lifecycle.network.dscp import describe
from lifecycle.network.medium import NETWORK_MEDIA
from lifecycle.plan.model import Plan
from lifecycle.printable import columns, json_text, one_line, sentence
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules import RULES, rule
from lifecycle.verify.verdict import Finding, FlowReport, RunEnd, Verdict

_COLOURS = {Outcome.OK: "\x1b[32m", Outcome.VIOLATED: "\x1b[31m", Outcome.UNVERIFIABLE: "\x1b[33m"}
_RESET = "\x1b[0m"
_UNIQUE = {
    UniqueHow.NOT: "not unique",
    UniqueHow.WEAKLY: "weakly unique",
    UniqueHow.STRONGLY: "strongly unique",
    None: "uniqueness unknown",
}


def render_text(
    verdict: Verdict, *, colour: bool = False, flows: bool = True, width: int = 100
) -> str:
    """Write a verdict: violated findings first, then unverifiable ones, the flows, the run's end.

    Args:
        verdict: what to write.
        colour: mark outcomes with ANSI colours.
        flows: list the flows too.
        width: columns to wrap sentences at, 40 at least.

    Returns:
        Lines, each ended by a newline.
    """
    width = max(width, 40)
    lines = [_paint(_headline(verdict), verdict.verdict, colour=colour)]
    for outcome in (Outcome.VIOLATED, Outcome.UNVERIFIABLE):
        findings = [each for each in verdict.findings if each.outcome is outcome]
        for finding in findings:
            lines += ["", *_finding(finding, colour=colour, width=width)]
    if verdict.tolerated:
        named = ", ".join(each.name for each in verdict.tolerated)
        lines += ["", *_wrap(named, width, first="tolerated: ")]
    measured = [each for each in verdict.measured if each.bounds]
    if measured:
        lines += ["", "measured", *(one_line(f"  {each.describe()}") for each in measured)]
    if flows and verdict.flows:
        lines += ["", "flows", *_flows(verdict.flows, colour=colour)]
    if verdict.run is not None:
        lines += ["", *_wrap(verdict.run.describe(), width)]
    return "\n".join(lines) + "\n"


def _headline(verdict: Verdict) -> str:
    parts = []
    for outcome in (Outcome.VIOLATED, Outcome.UNVERIFIABLE):
        count = sum(each.outcome is outcome for each in verdict.findings)
        if count:
            parts.append(f"{count} {outcome.value}")
    count = len(verdict.flows)
    if count:
        parts.append(f"{count} flow{'s' if count > 1 else ''}")
    return f"verdict: {verdict.verdict.value}" + (f" ({', '.join(parts)})" if parts else "")


def _finding(finding: Finding, *, colour: bool, width: int) -> list[str]:
    head = _paint(finding.outcome.value, finding.outcome, colour=colour)
    lines = [f"{head} {finding.rule}: {one_line(finding.subject)}"]
    rows = [
        ("", finding.message),
        ("at", finding.at),
        ("to do", finding.hint),
    ]
    for label, text in rows:
        if text:
            indent = "  " + (f"{label:<10}" if label else "")
            lines += _wrap(text, width, first=indent)
    return lines


def _wrap(text: str, width: int, *, first: str = "") -> list[str]:
    """Wrap at spaces only: names and addresses stay whole. `first` starts the first line."""
    return textwrap.wrap(
        sentence(text),
        width,
        initial_indent=first,
        subsequent_indent=" " * len(first),
        break_long_words=False,
        break_on_hyphens=False,
    )


def _flows(flows: Sequence[FlowReport], *, colour: bool) -> list[str]:
    rows = [
        (
            one_line(flow.topic),
            one_line(f"{flow.publisher} → {flow.subscription}"),
            _UNIQUE[flow.unique],
            "" if flow.dscp is None else describe(flow.dscp),
            flow.effective_transport,
            _paint(flow.outcome.value, flow.outcome, colour=colour),
        )
        for flow in flows
    ]
    lines = []
    for flow, line in zip(flows, columns(rows, indent=2), strict=True):
        lines.append(line)
        if flow.effective_transport in NETWORK_MEDIA:
            lines += [one_line(f"    {each.describe()}") for each in flow.tuples]
    return lines


def _paint(text: str, outcome: Outcome, *, colour: bool) -> str:
    return f"{_COLOURS[outcome]}{text}{_RESET}" if colour else text


_IDS = frozenset(each.id for each in RULES)


def to_junit(verdict: Verdict, plan: Plan | None, *, strict: bool = False) -> str:
    """Write JUnit XML: a case for each finding, which fails if it refuses the system, and the end.

    Args:
        verdict: gives the cases.
        plan: None where there is none, because the manifest cannot be used.
        strict: what cannot be verified refuses the system, whatever its policy says.
    """
    cases = []
    for each in verdict.findings:
        refuses, text = _refuses(each, plan, strict=strict), _described(each)
        cases.append(
            Case(
                classname=each.rule,
                name=each.subject,
                at=each.at,
                failure=(each.message, text) if refuses else None,
                note="" if refuses else text,
            )
        )
    flows = "".join(f"{_flow(each)}\n" for each in verdict.flows)
    name = f"lifecycle verify {plan.system}" if plan else "lifecycle verify"
    return junit(name, [*cases, _end(verdict)], note=flows)


def _refuses(finding: Finding, plan: Plan | None, *, strict: bool) -> bool:
    """Return whether a finding keeps the gate closed."""
    if finding.outcome is not Outcome.UNVERIFIABLE:
        return finding.outcome is Outcome.VIOLATED
    if plan is not None and finding.rule in plan.policy.trust:
        return False
    blocks = plan is not None and plan.policy.unverifiable_blocks
    return strict or (blocks and (finding.rule not in _IDS or rule(finding.rule).may_block))


def _end(verdict: Verdict) -> Case:
    """Fail where the run was no success: one without a judged system must not read well."""
    run = verdict.run
    if run is None and verdict.judged:
        return Case(classname="run", name="end")
    run = run or RunEnd(reason="nothing was judged", reached=None, exit_code=1)
    text = run.describe() + "\n"
    if run.exit_code == 0:
        return Case(classname="run", name="end", note=text)
    return Case(classname="run", name="end", failure=(run.reason, text))


def _described(finding: Finding) -> str:
    return "".join(f"{line}\n" for line in _finding(finding, colour=False, width=100))


def _flow(flow: FlowReport) -> str:
    return one_line(f"{flow.topic}: {flow.publisher} → {flow.subscription}: {flow.outcome.value}")


_LEVELS = {Outcome.VIOLATED: "error", Outcome.UNVERIFIABLE: "warning", Outcome.OK: "none"}


def to_sarif(verdict: Verdict) -> str:
    """Write a SARIF log with one run; every rule is described, found or not."""
    rules: list[Json] = [
        {
            "id": each.id,
            "shortDescription": {"text": each.meaning},
            "help": {"text": each.fix},
            "defaultConfiguration": {"level": _LEVELS[each.outcomes[0]]},
        }
        for each in RULES
    ]
    return sarif(
        [*map(_problem, verdict.findings), *_end_result(verdict)],
        rules,
        properties={"verdict": verdict.verdict.value},
        invocation=_invocation(verdict.run),
    )


def _invocation(run: RunEnd | None) -> Json | None:
    if run is None:
        return None
    return {
        "executionSuccessful": run.exit_code == 0,
        "exitCode": run.exit_code,
        "exitCodeDescription": run.describe(),
    }


def _end_result(verdict: Verdict) -> list[Problem]:
    """Return the error of a run that was no success, for a log that has none."""
    run = verdict.run
    if run is None or run.exit_code == 0:
        return []
    if any(each.outcome is Outcome.VIOLATED for each in verdict.findings):
        return []
    return [Problem(rule="run.end", level="error", message=run.describe())]


def _problem(finding: Finding) -> Problem:
    return Problem(
        rule=finding.rule,
        level=_LEVELS[finding.outcome],
        message=finding.message,
        hint=finding.hint,
        subject=finding.subject,
        at=finding.at,
        properties={
            "outcome": finding.outcome.value,
            "expected": finding.expected,
            "observed": finding.observed,
        },
    )


def to_github(verdict: Verdict, *, strict: bool = False) -> str:
    """Write the text, and an annotation for each finding; `strict` makes all of them errors."""
    found = map(_problem, verdict.findings)
    errors = (replace(each, level="error") if strict else each for each in found)
    return "".join((render_text(verdict), *(f"{github(each)}\n" for each in errors)))


def to_json(verdict: Verdict, *, indent: int | None = None) -> str:
    """Write the verdict, without what is as it mostly is: where no system was judged, `judged` is.

    `indent`: spaces per level; None for one line.
    """
    text = codec.to_json(verdict)
    if indent is not None:
        text = msgspec.json.format(text, indent=indent)
    return json_text(text.decode())
