"""Is the system up and running? The plan beside the state of the graph.

Owns: that one question, answered with what is missing. It is not the gate: whether what runs is
exactly what was declared is `lifecycle.verify`'s to say. Pure.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator

from lifecycle.graph.model import Link, NodeLiveliness, NodeView
from lifecycle.plan.model import Plan, PlannedEndpoint, PlannedNode
from lifecycle.verify.observation import EndpointReport
from lifecycle.verify.verdict import Outcome


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Running:
    """The answer.

    Attributes:
        outcome: OK: everything planned is there, active and connected; VIOLATED: something is
            missing; UNVERIFIABLE: nothing is known to be missing, but not everything is known.
        missing: what is missing, one phrase each, in plan order.
        unknown: what cannot be told, likewise.
    """

    outcome: Outcome
    missing: tuple[str, ...] = ()
    unknown: tuple[str, ...] = ()


_Finding = tuple[Outcome, str]


def up_and_running(
    plan: Plan,
    node: Callable[[str], NodeView | None],
    links: Callable[[str, str, str], tuple[Link, ...]],
) -> Running:
    """Answer for `plan`.

    Args:
        plan: what must be there.
        node: returns what is known of a node (fully qualified).
        links: returns the links of a topic from one node to another.
    """
    findings: list[_Finding] = []
    for planned in plan.nodes:
        findings += _node(planned, node(planned.full_name))
    there = {planned.key for planned in plan.nodes if node(planned.full_name) is not None}
    names = {planned.key: planned.full_name for planned in plan.nodes}
    for flow in plan.flows:
        if {flow.publisher, flow.subscription} <= there:
            publisher, subscription = names[flow.publisher], names[flow.subscription]
            subject = f"{flow.topic}: {publisher} → {subscription}"
            findings += _flow(subject, links(flow.topic, publisher, subscription))
    missing = tuple(text for outcome, text in findings if outcome is Outcome.VIOLATED)
    unknown = tuple(text for outcome, text in findings if outcome is Outcome.UNVERIFIABLE)
    outcome = Outcome.VIOLATED if missing else Outcome.UNVERIFIABLE if unknown else Outcome.OK
    return Running(outcome=outcome, missing=missing, unknown=unknown)


def _node(planned: PlannedNode, view: NodeView | None) -> Iterator[_Finding]:
    name = planned.full_name
    if view is None:
        yield Outcome.VIOLATED, f"{name} is not there"
        return
    if view.liveliness is not NodeLiveliness.ALIVE:
        yield Outcome.VIOLATED, f"{name} is {view.liveliness.value}: {view.reason}"
    if planned.managed and view.state is None:
        yield Outcome.UNVERIFIABLE, f"the state of {name} is not known"
    elif planned.managed and view.state != "active":
        yield Outcome.VIOLATED, f"{name} is {view.state or 'not managed'}, not active"
    if view.configuration is None:
        if planned.endpoints:
            yield Outcome.UNVERIFIABLE, f"the endpoints of {name} are not known"
        return
    for endpoint in planned.endpoints:
        yield from _endpoint(name, endpoint, view)


def _endpoint(node: str, planned: PlannedEndpoint, view: NodeView) -> Iterator[_Finding]:
    what = f"{node}: {planned.kind.value}/{planned.name}"
    found = [each for each in view.endpoints if _is(planned, each)]
    if not found:
        yield Outcome.VIOLATED, f"{what} is not there"
    elif found[0].error:
        yield Outcome.VIOLATED, f"{what}: {found[0].error}"
    elif planned.kind.is_topic and not any(each.mapped or each.gid for each in found):
        yield Outcome.VIOLATED, f"{what} is not mapped onto a connection"


def _is(planned: PlannedEndpoint, endpoint: EndpointReport) -> bool:
    return planned.kind is endpoint.kind and planned.resolved in (
        endpoint.resolved,
        *endpoint.aliases,
    )


def _flow(subject: str, links: tuple[Link, ...]) -> Iterator[_Finding]:
    outcomes = {each.connected for each in links}
    if not links or Outcome.OK in outcomes:
        return  # without links an end is missing or not known, and that was said of its node
    worst = Outcome.VIOLATED if Outcome.VIOLATED in outcomes else Outcome.UNVERIFIABLE
    reason = next(each.reason for each in links if each.connected is worst)
    yield worst, f"{subject}: {reason}"
