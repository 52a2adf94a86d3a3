"""What a verdict still waits for, or takes on trust, in one line.

Owns: `missing`, `not_ok`, `taken_on_trust`. Pure.
"""

from __future__ import annotations

from lifecycle.verify.rules import rule
from lifecycle.verify.verdict import Outcome, Verdict


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
    broken = {each.rule for each in findings}
    for finding in findings:
        kind = rule(finding.rule)
        named = f"{finding.subject} ({finding.rule})"
        if kind.absence and finding.outcome is Outcome.VIOLATED:
            what = finding.endpoint.noun if finding.endpoint else ""
            phrase = kind.absence.format(kind=what, node=finding.node)
            absent.append(f"{finding.subject} ({phrase})")
        elif kind.awaits is not None:
            # While what would tell is missing, that is what is waited for.
            if kind.awaits.id not in broken:
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
            what = f"{finding.expected} of " if rule(finding.rule).names_expected else ""
            by_rule.setdefault(finding.rule, []).append(f"{what}{finding.subject}")
    parts = []
    for rule_id, found in list(by_rule.items())[:_NAMED_RULES]:
        subjects = list(dict.fromkeys(found))
        more = len(subjects) - _NAMED_EACH
        named = ", ".join(subjects[:_NAMED_EACH])
        parts.append(named + (f" and {more} more" if more > 0 else "") + f" ({rule_id})")
    if len(by_rule) > _NAMED_RULES:
        parts.append(f"and {len(by_rule) - _NAMED_RULES} more rules")
    line = "; ".join(parts)
    return line if len(line) <= _LONGEST else f"{line[: _LONGEST - 1]}…"
