"""What a finding says, as text to compare."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable

from lifecycle.verify.rules import rule
from lifecycle.verify.verdict import Finding


def told(findings: Iterable[Finding]) -> str:
    """One paragraph for each finding, with its hint where that is not the rule's."""
    return "\n".join(_paragraph(each) for each in findings)


def _paragraph(finding: Finding) -> str:
    kind = f" ({finding.endpoint.noun})" if finding.endpoint else ""
    of = f", of {' and '.join(finding.ends)}" if finding.ends else ""
    facts = [
        f"{finding.outcome.value} {finding.rule}: {finding.subject}",
        finding.message,
        f"expected {finding.expected}, observed {finding.observed}",
        f"at {finding.at or 'nowhere'}, on {finding.node or 'no node'}{kind}{of}",
    ]
    if finding.hint != rule(finding.rule).fix:
        facts.append(f"to do: {finding.hint}")
    return "".join(
        textwrap.fill(
            fact, 96, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False
        )
        + "\n"
        for fact in facts
    )
