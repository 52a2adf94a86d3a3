"""Rule about the health that nodes report of themselves: their `health` method. Pure."""

from __future__ import annotations

from collections.abc import Iterator

from lifecycle.plan import PlannedNode
from lifecycle.verify.observation import HealthReport
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules.catalogue import About, Heals, Rule
from lifecycle.verify.verdict import Finding
from lifecycle.verify.view import NodeFacts, View

UNHEALTHY = Rule(
    id="node.unhealthy",
    meaning="a node says that it is not healthy, or does not say how it is",
    outcomes=(Outcome.VIOLATED, Outcome.UNVERIFIABLE),
    fix="the message says what is wrong; look at the node's log",
    about=About.PROGRESS,
    heals=Heals.WITH_TIME,
)
RULES = (UNHEALTHY,)

_HEALTHY = "healthy"


def is_healthy(node: PlannedNode, report: HealthReport | None) -> bool:
    """Return whether a node reports the health that its manifest asks of it, if it asks for any."""
    return node.health is None or (report is not None and report.ok is True)


def check(view: View) -> Iterator[Finding]:
    """Judge the health of every node of which the manifest asks it."""
    yield from view.by_node.each(_judge)


def _judge(facts: NodeFacts) -> Iterator[Finding]:
    node, report = facts.node, facts.configuration
    if node.health is None or facts.absent:
        return
    if facts.frame.ours(node) and (report is None or not report.connected):
        return  # it is asked once it is connected; until then its state or lack of report says it
    health = None if report is None else report.health
    if health is None:
        yield _unknown(node, "it reports no health; its class needs a method 'health'")
    elif health.ok is None:
        yield _unknown(node, health.message)
    elif not health.ok:
        yield _violated(node, health)


def _violated(node: PlannedNode, health: HealthReport) -> Finding:
    return UNHEALTHY.on_node(
        Outcome.VIOLATED,
        node,
        expected=_HEALTHY,
        observed=health.message,
        message=f"cannot accept node {node.full_name}: it is not healthy: {health.message}",
    )


def _unknown(node: PlannedNode, why: str) -> Finding:
    return UNHEALTHY.on_node(
        Outcome.UNVERIFIABLE,
        node,
        expected=_HEALTHY,
        observed="unknown",
        message=f"cannot verify that node {node.full_name} is healthy: {why}",
    )
