"""The verdict as text for people. Pure.

Owns: layout and wording; the findings' own sentences come from the rules.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

from lifecycle.manifest.model import UniqueHow
from lifecycle.network.dscp import describe
from lifecycle.printable import one_line
from lifecycle.verify.transport import NETWORK
from lifecycle.verify.verdict import Finding, FlowReport, Outcome, Verdict

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
        width: columns to wrap sentences at, >= 40.

    Returns:
        Lines, each ended by a newline.
    """
    lines = [_paint(_headline(verdict), verdict.verdict, colour=colour)]
    for outcome in (Outcome.VIOLATED, Outcome.UNVERIFIABLE):
        findings = [each for each in verdict.findings if each.outcome is outcome]
        for finding in findings:
            lines += ["", *_finding(finding, colour=colour, width=max(width, 40))]
    if verdict.open_endpoints:
        lines += ["", "endpoints that `endpoints: open` allows"]
        lines += [
            one_line(f"  {each.kind.noun} of {each.name} in {each.node}, {each.type}")
            for each in verdict.open_endpoints
        ]
    if verdict.tolerated:
        named = ", ".join(each.describe() for each in verdict.tolerated)
        lines += ["", *_wrap(named, max(width, 40), first="tolerated: ")]
    if flows and verdict.flows:
        lines += ["", "flows", *_flows(verdict.flows, colour=colour)]
    if verdict.run is not None:
        lines += ["", *_wrap(verdict.run.describe(), max(width, 40))]
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
        ("expected", finding.expected),
        ("observed", finding.observed),
        ("at", finding.at),
        ("to do", finding.hint),
    ]
    for label, text in rows:
        if text:
            indent = "  " + (f"{label:<10}" if label else "")
            lines += _wrap(text, width, first=indent)
    return lines


def _wrap(text: str, width: int, *, first: str = "") -> list[str]:
    """Wrap between words only: names and addresses stay whole. `first` starts the first line."""
    return textwrap.wrap(
        one_line(text),
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
        )
        for flow in flows
    ]
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = []
    for flow, row in zip(flows, rows, strict=True):
        cells = [cell.ljust(size) for cell, size in zip(row, widths, strict=True) if size]
        outcome = _paint(flow.outcome.value, flow.outcome, colour=colour)
        lines.append("  " + "  ".join([*cells, outcome]))
        if flow.effective_transport in NETWORK:
            lines += [one_line(f"    {each.describe()}") for each in flow.tuples]
    return lines


def _paint(text: str, outcome: Outcome, *, colour: bool) -> str:
    return f"{_COLOURS[outcome]}{text}{_RESET}" if colour else text
