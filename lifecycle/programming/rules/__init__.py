"""Verified flows as rules, settings and request bodies of other systems, and as tables. Pure."""

from __future__ import annotations

from lifecycle.programming.rules.registry import (
    EXPORTS,
    ExportInput,
    ExportSettings,
    export_input,
    flows_to_csv,
)
from lifecycle.programming.rules.rules import FlowRule, LeftOut, RuleSet, flow_rules

__all__ = [
    "EXPORTS",
    "ExportInput",
    "ExportSettings",
    "FlowRule",
    "LeftOut",
    "RuleSet",
    "export_input",
    "flow_rules",
    "flows_to_csv",
]
