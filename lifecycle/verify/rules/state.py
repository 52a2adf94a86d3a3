"""Rules about what nodes say of themselves: lifecycle states, health, configurations. Pure."""

from __future__ import annotations

import functools
from collections.abc import Iterator

from msgspec.structs import replace

from lifecycle.manifest.model import TargetState
from lifecycle.plan.model import PlannedNode
from lifecycle.verify.observation import HealthReport
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules.catalogue import About, Heals, Rule
from lifecycle.verify.verdict import Finding, Stage
from lifecycle.verify.view import NodeFacts, View, brings_up

_rule = functools.partial(Rule, about=About.PROGRESS, heals=Heals.WITH_TIME, if_undiscovered=True)

WRONG_STATE = _rule(
    id="state.wrong-state",
    meaning="a managed node is not in the state that this stage needs, or shows none",
    outcomes=(Outcome.VIOLATED, Outcome.UNVERIFIABLE),
    fix="look at the node's log for the transition that failed, or at who else drives it; a plain"
    " node must be declared `managed: false`",
)
ACTIVATED_AT_CLOSED_GATE = _rule(
    id="state.activated-at-closed-gate",
    meaning="a managed node was activated by its own code or another client at a closed gate",
    fix="find out who drives the node beside the supervisor, and let the gate activate it",
)
_INACTIVE = TargetState.INACTIVE.value


def _wanted(stage: Stage, node: PlannedNode) -> str:
    """Return the state that a node must be in: no further than it is to be brought."""
    if stage is Stage.CONNECTED and node.state is TargetState.ACTIVE:
        return _INACTIVE
    return node.state.value


def check(view: View) -> Iterator[Finding]:
    """Judge the state of every node, then the health of those that are asked, then the reports."""
    for facts in view.nodes.values():
        yield from _judge(view, facts)
    for facts in view.nodes.values():
        yield from _judge_health(view, facts)
        yield from _faults(facts)
    for facts in view.nodes.values():
        if not facts.is_ours or facts.absent:
            continue
        if facts.configuration is None:
            yield MISSING_REPORT.on(facts.node, expected="configuration", observed="no report")
            continue
        for actual in facts.actual:
            if actual.report is None:
                yield INCOMPLETE_REPORT.on(
                    actual, expected="in its node's report", observed="not mentioned"
                )


def _judge(view: View, facts: NodeFacts) -> Iterator[Finding]:
    node, name = facts.node, facts.name
    if not node.managed or facts.absent:
        return
    wanted = _wanted(view.stage, node)
    allowed = {wanted}
    ahead = view.stage is Stage.CONNECTED and name in view.ahead
    if ahead or (view.stage is Stage.CONNECTED and not brings_up(node, view.machines)):
        # Another supervisor brings it up, and its gate opens on the same proof, maybe before ours;
        # or an earlier gate let it through, and only others have to pass again.
        allowed.add(node.state.value)
    observed, report = facts.observed, facts.configuration
    # Both sources count: if they disagree one of them is late, and nothing is proven yet.
    states = dict.fromkeys(
        state
        for state in (observed.state if observed else None, report.state if report else None)
        if state
    )
    # On the way to what is allowed; `activating` is never the goal, so no message names it.
    passing = {"activating"} if ahead else set()
    wrong = [state for state in states if state not in allowed | passing]
    expected = wanted
    if view.stage is Stage.CONNECTED and facts.is_ours and wanted == _INACTIVE:
        expected = "inactive, connected"
        if not wrong and report is not None and not report.connected:
            wrong = ["inactive, disconnected"]
    expected = " or ".join([expected, *sorted(allowed - {wanted})])
    if wrong:
        yield WRONG_STATE.on(node, outcome=Outcome.VIOLATED, expected=expected, observed=wrong[0])
    elif observed is not None and observed.managed is False and not _reports_state(facts):
        yield WRONG_STATE.on(
            node,
            outcome=Outcome.VIOLATED,
            expected=expected,
            observed="no managed node: it offers no lifecycle services",
            hint="make it a managed node, or declare it `managed: false`",
        )
    elif not states:
        yield WRONG_STATE.on(
            node,
            outcome=Outcome.UNVERIFIABLE,
            expected=expected,
            observed="neither a report nor a service shows its state",
            hint="see whether its ~/get_state answers",
        )


def _reports_state(facts: NodeFacts) -> bool:
    """Return whether one of our nodes itself reports that it is managed, by its state.

    It is driven by its host and not by the services, which discovery may show late: the graph
    shows a node before all of its endpoints.
    """
    report = facts.configuration
    return facts.is_ours and report is not None and bool(report.state)


MISSING_REPORT = _rule(
    id="config.missing-report",
    meaning="a node of ours did not report its configuration",
    says="{who} did not report its {expected}",
    fix="see whether its ~/get_configuration answers; look at its log",
)
INCOMPLETE_REPORT = _rule(
    id="config.incomplete-report",
    meaning="a node of ours does not mention a declared endpoint in its report",
    fix="the node runs from another manifest, or has not connected: compare and restart it",
)
UNHEALTHY = Rule(
    id="node.unhealthy",
    meaning="a node says that it is not healthy, or does not say how it is",
    outcomes=(Outcome.VIOLATED, Outcome.UNVERIFIABLE),
    says="{who} is not {expected}: {observed}",
    fix="the message says what is wrong; look at the node's log",
    about=About.PROGRESS,
    heals=Heals.WITH_TIME,
)
RULES = (WRONG_STATE, ACTIVATED_AT_CLOSED_GATE, UNHEALTHY, MISSING_REPORT, INCOMPLETE_REPORT)

_NO_METHOD = HealthReport(
    ok=None, message="it reports no health; its class needs a method 'health'"
)


def health_of(
    node: PlannedNode, own: HealthReport | None, published: HealthReport | None
) -> HealthReport:
    """Return what is known of a node's health, of all that the manifest names.

    `own` is what its `health` method returned last, `published` what /diagnostics says of it.
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


def _judge_health(view: View, facts: NodeFacts) -> Iterator[Finding]:
    node, report = facts.node, facts.configuration
    if node.health is None or facts.absent:
        return
    # One that has the method reports what it returned, or that it has not returned, at once.
    if node.health.check and report is not None and report.connected and report.health is None:
        yield _unhealthy(node, replace(_NO_METHOD, ok=False))
        return
    # A method is asked from when its node is connected, and a held node publishes nothing before it
    # is active; until then its state, or the lack of a report, says enough.
    asks = not facts.is_ours or (report is not None and report.connected)
    works = not node.holds or view.stage is Stage.ACTIVE or facts.name in view.ahead
    asked = replace(
        node.health,
        check=node.health.check and asks,
        diagnostics=node.health.diagnostics if works else (),
    )
    health = health_of(
        replace(node, health=asked),
        None if report is None else report.health,
        None if facts.observed is None else facts.observed.health,
    )
    if not health.ok:
        yield _unhealthy(node, health)


def _unhealthy(node: PlannedNode, health: HealthReport) -> Finding:
    outcome = Outcome.UNVERIFIABLE if health.ok is None else Outcome.VIOLATED
    return UNHEALTHY.on(node, outcome=outcome, expected="healthy", observed=health.message)


def _faults(facts: NodeFacts) -> Iterator[Finding]:
    """Find action servers of which the handler raised at the last goal, whatever is asked."""
    report = facts.configuration
    for each in () if report is None or facts.absent else report.endpoints:
        if each.fault:
            wrong = f"{each.kind.noun} {each.name!r}: {each.fault}"
            yield _unhealthy(facts.node, HealthReport(ok=False, message=wrong))
