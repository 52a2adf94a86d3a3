"""What a verdict still waits for, in one line. Owns: `missing`, `not_ok`. Pure."""

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
    absent: dict[str, None] = {}
    wrong: dict[str, None] = {}
    unknown: dict[str, None] = {}
    comes = any(each.rule == _NODE for each in findings)
    for finding in findings:
        phrase = _ABSENT.get(finding.rule)
        named = f"{finding.subject} ({finding.rule})"
        if phrase is not None and finding.outcome is Outcome.VIOLATED:
            absent[f"{finding.subject} ({_what(finding, phrase)})"] = None
        elif finding.rule == _UNATTRIBUTED:
            # Discovery tells of an endpoint before it tells of its node: most likely that one's.
            if not comes:
                unknown[named] = None
        elif finding.outcome is Outcome.UNVERIFIABLE:
            unknown[named] = None
        else:
            wrong[named] = None
    parts = []
    if absent:
        parts.append("missing: " + ", ".join(absent))
    if wrong:
        parts.append("wrong: " + ", ".join(wrong))
    if unknown:
        parts.append("unknown: " + ", ".join(unknown))
    return "; ".join(parts)


def not_ok(verdict: Verdict) -> str:
    """Summarise what keeps a verdict from being ok, whether it closes the gate or not.

    Returns:
        As `missing`; where that is empty, `unknown: /robot/video (graph.unattributed-endpoint)`;
        empty for a verdict that is ok.
    """
    subjects = dict.fromkeys(f"{each.subject} ({each.rule})" for each in verdict.findings)
    return missing(verdict) or (f"unknown: {', '.join(subjects)}" if subjects else "")


_NODE = "graph.missing-node"
_UNATTRIBUTED = "graph.unattributed-endpoint"

_ABSENT = {
    _NODE: "node",
    "graph.missing-endpoint": "{kind} of {node}",
    "graph.unmatched-link": "match",
    "graph.unmatched-flow": "match",
    "graph.unmatched-client": "match",
    "config.missing-report": "report",
    "config.incomplete-report": "{kind} in the report of {node}",
}
"""Rules that say that something is not there (yet), and how to call it."""


def _what(finding: Finding, phrase: str) -> str:
    kind = finding.endpoint.noun if finding.endpoint else ""
    return phrase.format(kind=kind, node=finding.node)
