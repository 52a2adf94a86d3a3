"""What was found, in one line for each finding: all of it but the wording."""

from __future__ import annotations

from collections.abc import Iterable

from lifecycle.verify.verdict import Finding


def lines(findings: Iterable[Finding]) -> list[str]:
    """Return outcome, rule, subject, node and place (line:column) of each finding."""
    return [_line(each) for each in findings]


def _line(finding: Finding) -> str:
    texts = (finding.message, finding.expected, finding.observed, finding.hint)
    assert all(isinstance(each, str) for each in texts), finding
    kind = f" ({finding.endpoint.noun})" if finding.endpoint else ""
    at = f" at {str(finding.at).partition(':')[2]}" if finding.at else ""
    what = f"{finding.outcome.value} {finding.rule}: {finding.subject}"
    return f"{what}, {finding.node or 'no node'}{kind}{at}"
