"""Verifies Plan × Observation → Verdict, and reports it. Pure: no ROS, no files, no clock."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lifecycle.public import public_name

if TYPE_CHECKING:
    from lifecycle.verify.judge import verify as verify
    from lifecycle.verify.outcome import Outcome as Outcome
    from lifecycle.verify.verdict import Finding as Finding
    from lifecycle.verify.verdict import Verdict as Verdict

_PUBLIC: dict[str, tuple[str, ...]] = {
    "lifecycle.verify.judge": ("verify",),
    "lifecycle.verify.outcome": ("Outcome",),
    "lifecycle.verify.verdict": ("Finding", "Verdict"),
}
"""What programs import from here (docs/api.md), by the module that has it."""


def __getattr__(name: str) -> object:
    """Load the module of a public name on first use (PEP 562)."""
    return public_name(__name__, _PUBLIC, name)
