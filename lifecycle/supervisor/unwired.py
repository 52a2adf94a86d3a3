"""The finding that a node, or the system, could not be wired. Owns: `not_wired`. Pure."""

from __future__ import annotations

from lifecycle.supervisor.failure import NOT_WIRED
from lifecycle.verify.rules import rule
from lifecycle.verify.verdict import Finding, Outcome


def not_wired(subject: str, message: str) -> Finding:
    """Return it.

    Args:
        subject: fully qualified node name, or the system's name.
        message: a whole sentence with the reason.
    """
    return rule(NOT_WIRED).finding(
        Outcome.VIOLATED,
        subject=subject,
        expected="wired",
        observed="not wired",
        message=message,
        node=subject if subject.startswith("/") else "",
    )
