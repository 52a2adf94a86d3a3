"""What a verdict still waits for, or takes on trust, in one line.

Owns: `missing`, `not_ok`, `taken_on_trust`. Pure.
"""

from __future__ import annotations

from lifecycle.verify.verdict import Finding, Outcome, Verdict


def missing(verdict: Verdict) -> str:
    """Summarise the findings that keep the gate closed, for the message of a passed deadline.

    Returns:
        `missing: /robot/camera (node), /robot/video (publisher of /robot/camera)`, then what is
        there but wrong, `wrong: /robot/base (state.wrong-state)`, then what nobody can tell yet,
        `unknown: /robot/scan (graph.unattributed-endpoint)`; empty when nothing is waited for.
    """
    findings = [each for each in verdict.findings if each.outcome is Outcome.VIOLATED]
    if not findings and verdict.blocking:
        findings = list(verdict.findings)
    absent: list[str] = []
    wrong: list[str] = []
    unknown: list[str] = []
    comes = any(each.rule == _NODE for each in findings)
    reports = any(each.rule == _REPORT for each in findings)
    for finding in findings:
        phrase = _ABSENT.get(finding.rule)
        named = f"{finding.subject} ({finding.rule})"
        if phrase is not None and finding.outcome is Outcome.VIOLATED:
            absent.append(f"{finding.subject} ({_what(finding, phrase)})")
        elif finding.rule == _UNATTRIBUTED:
            # Discovery tells of an endpoint before it tells of its node: most likely that one's.
            if not comes:
                unknown.append(named)
        elif finding.rule == _UNPROVEN:
            # Of a node whose report is missing, the report is what is waited for.
            if not reports:
                unknown.append(named)
        elif finding.outcome is Outcome.UNVERIFIABLE:
            unknown.append(named)
        else:
            wrong.append(named)
    parts = []
    if absent:
        parts.append("missing: " + ", ".join(dict.fromkeys(absent)))
    if wrong:
        parts.append("wrong: " + ", ".join(dict.fromkeys(wrong)))
    if unknown:
        parts.append("unknown: " + ", ".join(dict.fromkeys(unknown)))
    return "; ".join(parts)


def not_ok(verdict: Verdict) -> str:
    """Summarise what keeps a verdict from being ok, whether it closes the gate or not.

    Returns:
        As `missing`; where that is empty, `unknown: /robot/video (graph.unattributed-endpoint)`;
        empty for a verdict that is ok.
    """
    subjects = dict.fromkeys(f"{each.subject} ({each.rule})" for each in verdict.findings)
    return missing(verdict) or (f"unknown: {', '.join(subjects)}" if subjects else "")


_NAMED_EACH = 2
_NAMED_RULES = 4
_LONGEST = 500


def taken_on_trust(verdict: Verdict) -> str:
    """Summarise what is unverifiable in one bounded line, for a gate that opens in spite of it.

    Returns:
        `max_delay_ms 5 of /robot/video: /camera → /viewer, rate_hz 15 of /robot/video and 3 more
        (flow.not-measured); /camera (graph.qos-unverifiable)`: by rule, at most two of each; empty
        if nothing is.
    """
    by_rule: dict[str, list[str]] = {}
    for finding in verdict.findings:
        if finding.outcome is Outcome.UNVERIFIABLE:
            number = f"{finding.expected} of " if finding.rule == _NOT_MEASURED else ""
            by_rule.setdefault(finding.rule, []).append(f"{number}{finding.subject}")
    parts = []
    for rule, found in list(by_rule.items())[:_NAMED_RULES]:
        subjects = list(dict.fromkeys(found))
        more = len(subjects) - _NAMED_EACH
        named = ", ".join(subjects[:_NAMED_EACH])
        parts.append(named + (f" and {more} more" if more > 0 else "") + f" ({rule})")
    if len(by_rule) > _NAMED_RULES:
        parts.append(f"and {len(by_rule) - _NAMED_RULES} more rules")
    line = "; ".join(parts)
    return line if len(line) <= _LONGEST else f"{line[: _LONGEST - 1]}…"


_NOT_MEASURED = "flow.not-measured"
_NODE = "graph.missing-node"
_REPORT = "config.missing-report"
_UNPROVEN = "flow.unverifiable"
_UNATTRIBUTED = "graph.unattributed-endpoint"

_ABSENT = {
    _NODE: "node",
    "graph.missing-endpoint": "{kind} of {node}",
    "graph.unmatched-link": "match",
    "graph.unmatched-flow": "match",
    "graph.unmatched-client": "match",
    _REPORT: "report",
    "config.incomplete-report": "{kind} in the report of {node}",
}
"""Rules that say that something is not there (yet), and how to call it."""


def _what(finding: Finding, phrase: str) -> str:
    kind = finding.endpoint.noun if finding.endpoint else ""
    return phrase.format(kind=kind, node=finding.node)
