"""Verifies Plan × Observation → Verdict, and reports it. Pure: no ROS, no files, no clock."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

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
    for module, names in _PUBLIC.items():
        if name in names:
            return getattr(importlib.import_module(module), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
