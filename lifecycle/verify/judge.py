"""Plan × Observation → Verdict.

Owns: `verify`, and when a verdict closes the gate. Everything it needs is in its arguments. Pure.
"""

from __future__ import annotations

from collections.abc import Sequence

from lifecycle.manifest.model import EndpointPolicy
from lifecycle.plan.model import Plan
from lifecycle.verify.flow_reports import flow_reports
from lifecycle.verify.layout import lay_out
from lifecycle.verify.noise import OUR_NODES
from lifecycle.verify.observation import Observation
from lifecycle.verify.rules import CHECKS, rule
from lifecycle.verify.verdict import (
    Finding,
    OpenEndpoint,
    Outcome,
    Stage,
    ToleratedNode,
    Verdict,
)
from lifecycle.verify.view import View


def verify(
    plan: Plan,
    observation: Observation,
    *,
    stage: Stage,
    machines: frozenset[str] | None = None,
    ahead: frozenset[str] = frozenset(),
) -> Verdict:
    """Judge what was seen of a system against what was planned.

    Every rule is applied, so that all findings come at once. The result depends on the content of
    the arguments alone, not on the order of what was observed.

    Args:
        plan: what must be.
        observation: what was seen, tools and client library endpoints left in or not.
        stage: which moment it is judged against.
        machines: names of the machines whose nodes the caller brings up; those of others are
            brought up by somebody else and may be active before ours. None: all are ours.
        ahead: fully qualified names of nodes that an earlier gate let through, which may be active
            although this one has not opened yet.
    """
    view = lay_out(plan, observation, stage, machines=machines, ahead=ahead)
    findings = tuple(finding for check in CHECKS for finding in check(view))
    return Verdict(
        verdict=Outcome.worst(each.outcome for each in findings),
        blocking=_blocks(findings, unverifiable_blocks=plan.policy.unverifiable_blocks),
        findings=findings,
        flows=flow_reports(view, findings),
        open_endpoints=tuple(
            OpenEndpoint(kind=each.kind, node=each.node, name=each.name, type=each.type)
            for each in view.undeclared
            if view.planned[each.node].endpoint_policy is EndpointPolicy.OPEN
        ),
        tolerated=_tolerated(view),
    )


def _tolerated(view: View) -> tuple[ToleratedNode, ...]:
    """List the undeclared nodes that the policy lets be there, sorted by name."""
    because = {name: f"tolerated_nodes: {pattern}" for name, pattern in view.tools.items()}
    endpoints = list(view.of_tools)
    if view.plan.policy.undeclared_nodes is EndpointPolicy.OPEN:
        others = (*view.foreign, *view.unattributed)
        undeclared = {name for name in view.observed if name not in view.planned}
        undeclared |= {each.node for each in others}
        because |= dict.fromkeys(undeclared, "undeclared_nodes: open")
        endpoints += others
    has = {
        name: tuple(
            OpenEndpoint(kind=each.kind, node=name, name=each.name, type=each.type)
            for each in endpoints
            if each.node == name
        )
        for name in because
    }
    return tuple(
        ToleratedNode(node=name, because=because[name], endpoints=has[name])
        for name in sorted(because)
        if has[name] or view.tools.get(name) != OUR_NODES
    )


def _blocks(findings: Sequence[Finding], *, unverifiable_blocks: bool) -> bool:
    return any(
        finding.outcome is Outcome.VIOLATED
        or (unverifiable_blocks and rule(finding.rule).may_block)
        for finding in findings
    )
