"""Plans and flows as other systems' files: tables, network rules; pictures in `picture`. Pure."""

from __future__ import annotations

from lifecycle.export.flows_csv import flows_to_csv
from lifecycle.export.registry import EXPORTS, ExportInput, ExportSettings, export_input
from lifecycle.export.rules import FlowRule, LeftOut, RuleSet, flow_rules

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
