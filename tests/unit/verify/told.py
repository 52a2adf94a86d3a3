"""Everything that a finding says, as text to compare whole."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable

from lifecycle.verify import Finding


def told(findings: Iterable[Finding]) -> str:
    """One paragraph for each finding, one fact a line; no line longer than a test's may be."""
    return "\n".join(_paragraph(each) for each in findings)


def _paragraph(finding: Finding) -> str:
    kind = f" ({finding.endpoint.noun})" if finding.endpoint else ""
    facts = (
        f"{finding.outcome.value} {finding.rule}: {finding.subject}",
        finding.message,
        f"expected: {finding.expected}",
        f"observed: {finding.observed}",
        f"at: {finding.at or 'nowhere'}, on {finding.node or 'no node'}{kind}",
        f"to do: {finding.hint}",
    )
    return "".join(
        textwrap.fill(
            fact, 96, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False
        )
        + "\n"
        for fact in facts
    )
