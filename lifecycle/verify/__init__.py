"""Verifies Plan × Observation → Verdict, and reports it. Pure: no ROS, no files, no clock."""

from lifecycle.verify.judge import missing, not_ok, verify
from lifecycle.verify.observation import (
    EndpointReport,
    Identity,
    NodeConfiguration,
    Observation,
    ObservedEndpoint,
    ObservedNode,
)
from lifecycle.verify.report import render_text, to_json, to_junit, to_sarif
from lifecycle.verify.rules import RULES, Rule
from lifecycle.verify.tool_filter import (
    action_part,
    fold_actions,
    is_noise_endpoint,
    is_noise_node,
    our_nodes,
    without_noise,
)
from lifecycle.verify.verdict import (
    NOT_JUDGED,
    Finding,
    FlowReport,
    Outcome,
    RunEnd,
    Stage,
    Verdict,
)

__all__ = [
    "NOT_JUDGED",
    "RULES",
    "EndpointReport",
    "Finding",
    "FlowReport",
    "Identity",
    "NodeConfiguration",
    "Observation",
    "ObservedEndpoint",
    "ObservedNode",
    "Outcome",
    "Rule",
    "RunEnd",
    "Stage",
    "Verdict",
    "action_part",
    "fold_actions",
    "is_noise_endpoint",
    "is_noise_node",
    "missing",
    "not_ok",
    "our_nodes",
    "render_text",
    "to_json",
    "to_junit",
    "to_sarif",
    "verify",
    "without_noise",
]
