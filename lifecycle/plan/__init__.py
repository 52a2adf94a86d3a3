"""Manifest → Plan: the computational and the data layer graph of a system, ready to run. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lifecycle.public import public_name

if TYPE_CHECKING:
    from lifecycle.plan.build import build_plan as build_plan
    from lifecycle.plan.model import Plan as Plan

_PUBLIC: dict[str, tuple[str, ...]] = {
    "lifecycle.plan.build": ("build_plan",),
    "lifecycle.plan.model": ("Plan",),
}
"""What programs import from here (docs/api.md), by the module that has it."""


def __getattr__(name: str) -> object:
    """Load the module of a public name on first use (PEP 562)."""
    return public_name(__name__, _PUBLIC, name)
