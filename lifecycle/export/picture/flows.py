"""The flows of a picture: what carries each, between which participants, and how unique it is.

Owns: turning flow reports and undeclared pairs into PicturedFlows. Pure.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping

from lifecycle.export.picture.basis import Basis
from lifecycle.export.picture.model import PicturedFlow, PicturedNode, Presence
from lifecycle.export.picture.participants import carrier
from lifecycle.manifest.model import EndpointKind, UniqueHow
from lifecycle.network.dscp import describe
from lifecycle.network.nfe import UniqueRequirement
from lifecycle.verify.verdict import FlowReport, Outcome
from lifecycle.verify.view import FlowView, Seen, View

_UNIQUE = {
    None: "uniqueness unknown",
    UniqueHow.NOT: "not unique",
    UniqueHow.WEAKLY: "weakly unique",
    UniqueHow.STRONGLY: "strongly unique",
}


def pictured_flows(basis: Basis, nodes: Mapping[str, PicturedNode]) -> tuple[PicturedFlow, ...]:
    """Return every planned flow in plan order, then every pair that nobody declared.

    Args:
        basis: what the picture is drawn from.
        nodes: those of the picture, by full name.
    """
    declared = [
        _declared(f"f{number}", basis, flow, nodes) for number, flow in enumerate(basis.view.flows)
    ]
    return (*declared, *_undeclared(basis.view, nodes, first=len(declared)))


def _declared(
    id_: str, basis: Basis, flow: FlowView, nodes: Mapping[str, PicturedNode]
) -> PicturedFlow:
    ends = (*flow.publishers, *flow.subscriptions)
    there = flow.publishers and flow.subscriptions and all(each.observed for each in ends)
    drawn = PicturedFlow(
        id=id_,
        topic=flow.planned.topic,
        publisher=carrier(basis, nodes[flow.publisher], flow.publishers).id,
        subscription=carrier(basis, nodes[flow.subscription], flow.subscriptions).id,
        names=(flow.publisher, flow.subscription),
        presence=Presence.PRESENT if there else basis.absent,
        outcome=Outcome.UNVERIFIABLE,
        medium="unknown",
        planned=flow.planned.medium,
        tuples=(),
        dscp="",
        unique=_UNIQUE[None],
        demands=tuple(_demands(flow)),
        findings=basis.numbers(
            lambda each: (
                each.subject == flow.subject
                or (
                    each.subject == flow.planned.topic
                    and each.node in (flow.publisher, flow.subscription)
                )
            )
        ),
    )
    if basis.verdict is None:
        return _as_asked(drawn, flow)
    report = basis.reports.get((flow.planned.topic, flow.publisher, flow.subscription))
    return drawn if report is None else _as_found(drawn, report)


def _as_asked(drawn: PicturedFlow, flow: FlowView) -> PicturedFlow:
    asked = (each.planned.dscp for each in flow.publishers)
    marks = dict.fromkeys(each for each in asked if each is not None)
    demanded = flow.planned.unique
    return dataclasses.replace(
        drawn,
        outcome=None,
        medium=flow.planned.medium,
        dscp=", ".join(map(describe, marks)),
        unique="" if demanded is UniqueHow.NOT else _UNIQUE[demanded],
    )


def _as_found(drawn: PicturedFlow, report: FlowReport) -> PicturedFlow:
    return dataclasses.replace(
        drawn,
        outcome=report.outcome,
        medium=report.effective_transport,
        tuples=tuple(each.describe() for each in report.tuples),
        dscp="" if report.dscp is None else describe(report.dscp),
        unique=_UNIQUE[report.unique],
    )


def _demands(flow: FlowView) -> Iterable[str]:
    if flow.planned.unique is not UniqueHow.NOT:
        yield f"{flow.planned.unique.value} unique demanded"
    for word, need in zip(("publisher", "subscription"), flow.requirement, strict=True):
        if need is not UniqueRequirement.NOT_REQUIRED:
            yield f"{word} unique {need.value}"
    if flow.planned.max_delay_ms is not None:
        yield f"at most {flow.planned.max_delay_ms:g} ms"
    if flow.five_qi is not None:
        yield f"5QI {flow.five_qi}"


def _undeclared(
    view: View, nodes: Mapping[str, PicturedNode], *, first: int
) -> Iterable[PicturedFlow]:
    """Pairs of one topic and type of which at least one end is not declared."""
    sides: dict[tuple[str, str, EndpointKind], list[Seen]] = {}
    for seen in view.seen:
        sides.setdefault((seen.name, seen.type, seen.kind), []).append(seen)
    done: dict[tuple[str, str, str], None] = {}
    for (topic, type_, kind), publishers in sides.items():
        if kind is not EndpointKind.PUBLISHER:
            continue
        for publisher in publishers:
            for other in sides.get((topic, type_, EndpointKind.SUBSCRIPTION), ()):
                known = publisher.planned is not None and other.planned is not None
                if not known and publisher.node in nodes and other.node in nodes:
                    done[topic, publisher.node, other.node] = None
    for number, (topic, source, target) in enumerate(done, start=first):
        yield PicturedFlow(
            id=f"f{number}",
            topic=topic,
            publisher=nodes[source].participants[0].id,
            subscription=nodes[target].participants[0].id,
            names=(nodes[source].name, nodes[target].name),
            presence=Presence.UNDECLARED,
            outcome=Outcome.VIOLATED,
            medium="unknown",
            planned="",
            tuples=(),
            dscp="",
            unique=_UNIQUE[None],
            demands=(),
            findings=(),
        )
