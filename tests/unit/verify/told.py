"""What was found, in one line for each finding."""

from __future__ import annotations

from collections.abc import Iterable

from lifecycle.verify.verdict import Finding


def told(findings: Iterable[Finding]) -> list[str]:
    """Return outcome, rule and subject of each finding."""
    return [f"{each.outcome.value} {each.rule}: {each.subject}" for each in findings]
