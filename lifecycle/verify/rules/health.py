"""Rules about the health of nodes: what their `health` method and /diagnostics say. Pure."""

from __future__ import annotations

from collections.abc import Iterator

import msgspec
from msgspec.structs import replace

from lifecycle.plan.model import PlannedNode
from lifecycle.verify.observation import HealthReport
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules.catalogue import About, Heals, Rule
from lifecycle.verify.verdict import Finding, Stage
from lifecycle.verify.view import NodeFacts, View

UNHEALTHY = Rule(
    id="node.unhealthy",
    meaning="a node says that it is not healthy, or does not say how it is",
    outcomes=(Outcome.VIOLATED, Outcome.UNVERIFIABLE),
    fix="the message says what is wrong; look at the node's log",
    about=About.PROGRESS,
    heals=Heals.WITH_TIME,
)
NOT_ASKED = Rule(
    id="node.without-health",
    meaning="a node is to be asked whether it is healthy, and its class has no `health` method",
    fix="give its class a method 'health', or write 'health: {diagnostics: NAME}'",
)
RULES = (UNHEALTHY, NOT_ASKED)

_HEALTHY = "healthy"
_NO_METHOD = HealthReport(
    ok=None, message="it reports no health; its class needs a method 'health'"
)


def health_of(
    node: PlannedNode, own: HealthReport | None, published: HealthReport | None
) -> HealthReport:
    """Return what is known of a node's health, of all that the manifest names.

    Args:
        node: as it is declared.
        own: what its `health` method returned last.
        published: what /diagnostics says of it.
    """
    said = []
    if node.health is not None and node.health.check:
        said.append(own or _NO_METHOD)
    if node.health is not None and node.health.diagnostics:
        names = ", ".join(map(repr, node.health.diagnostics))
        silent = f"nothing on /diagnostics is called {names}"
        said.append(published or HealthReport(ok=None, message=silent))
    for ok in (False, None):
        wrong = [each.message for each in said if each.ok is ok]
        if wrong:
            return HealthReport(ok=ok, message="; ".join(wrong))
    return HealthReport(ok=True)


def check(view: View) -> Iterator[Finding]:
    """Judge the health of every node of which the manifest asks it, and what handlers raised."""
    for facts in view.nodes.values():
        yield from _judge(view, facts)
        yield from _faults(facts)


def _judge(view: View, facts: NodeFacts) -> Iterator[Finding]:
    node, report = facts.node, facts.configuration
    if node.health is None or facts.absent:
        return
    # One that has the method reports what it returned, or that it has not returned, at once.
    lacks = report is not None and report.connected and report.health is None
    if node.health.check and lacks:
        yield NOT_ASKED.on(
            node,
            expected="a method 'health'",
            observed="none",
            message=f"node {node.full_name} is to be asked whether it is healthy, and "
            "its class has no method 'health'",
        )
    # A method is asked from when its node is connected, and a held node publishes nothing before it
    # is active; until then its state, or the lack of a report, says enough.
    asks = not facts.is_ours or (report is not None and report.connected)
    works = not node.holds or view.stage is Stage.ACTIVE or facts.name in view.ahead
    asked = msgspec.structs.replace(
        node.health,
        check=node.health.check and asks and not lacks,
        diagnostics=node.health.diagnostics if works else (),
    )
    health = health_of(
        replace(node, health=asked),
        None if report is None else report.health,
        None if facts.observed is None else facts.observed.health,
    )
    if health.ok is False:
        yield UNHEALTHY.on(
            node,
            outcome=Outcome.VIOLATED,
            expected=_HEALTHY,
            observed=health.message,
            message=f"node {node.full_name} is not healthy: {health.message}",
        )
    elif health.ok is None:
        yield UNHEALTHY.on(
            node,
            outcome=Outcome.UNVERIFIABLE,
            expected=_HEALTHY,
            observed="unknown",
            message=f"nothing shows that node {node.full_name} is healthy: {health.message}",
        )


def _faults(facts: NodeFacts) -> Iterator[Finding]:
    """Find action servers of which the handler raised at the last goal, whatever is asked."""
    node, report = facts.node, facts.configuration
    for each in () if report is None or facts.absent else report.endpoints:
        if each.fault:
            wrong = f"{each.kind.noun} {each.name!r}: {each.fault}"
            yield UNHEALTHY.on(
                node,
                outcome=Outcome.VIOLATED,
                expected=_HEALTHY,
                observed=wrong,
                message=f"node {node.full_name} is not healthy: {wrong}",
            )
