"""The finding that a node, or the system, could not be wired. Owns: `not_wired`. Pure."""

from __future__ import annotations

from lifecycle.verify.rules import run
from lifecycle.verify.verdict import Finding, Outcome


def not_wired(subject: str, message: str) -> Finding:
    """Return it.

    Args:
        subject: fully qualified node name, or the system's name.
        message: a whole sentence with the reason.
    """
    return run.NOT_WIRED.finding(
        Outcome.VIOLATED,
        subject=subject,
        expected="wired",
        observed="not wired",
        message=message,
        node=run.node_of(subject),
    )
