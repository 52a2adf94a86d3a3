"""Topics, services, actions, flows and participants as a picture shows them between nodes.

Owns: which ends and arrows a line has, and their remarks; turning flow reports and undeclared pairs
into PicturedFlows: what carries each, between which participants, and how unique it is; and
matching planned with reported participants, and which carries what. Pure.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from lifecycle import dataclasses
from lifecycle.export.picture.model import (
    Basis,
    LineKind,
    PicturedArrow,
    PicturedEnd,
    PicturedFlow,
    PicturedLine,
    PicturedNode,
    PicturedParticipant,
    Presence,
)
from lifecycle.manifest import EndpointKind, UniqueHow
from lifecycle.network import UniqueRequirement, describe
from lifecycle.plan import PlannedEndpoint, PlannedNode
from lifecycle.verify import (
    Actual,
    Finding,
    FlowReport,
    FlowView,
    NodeConfiguration,
    Outcome,
    SeenEndpoint,
    View,
)

_KINDS = (
    (LineKind.TOPIC, EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION),
    (LineKind.SERVICE, EndpointKind.SERVICE_CLIENT, EndpointKind.SERVICE_SERVER),
    (LineKind.ACTION, EndpointKind.ACTION_CLIENT, EndpointKind.ACTION_SERVER),
)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class _LineEnd:
    kind: EndpointKind
    name: str
    node: str
    type: str
    presence: Presence
    notes: tuple[str, ...] = ()


def pictured_lines(basis: Basis, nodes: Mapping[str, PicturedNode]) -> Iterable[PicturedLine]:
    """Yield topics, then services, then actions; `nodes` are by full name."""
    ends = list(_ends(basis))
    number = 0
    for kind, source_kind, target_kind in _KINDS:
        by_name: dict[str, list[_LineEnd]] = {}
        for end in ends:
            if end.kind in (source_kind, target_kind):
                by_name.setdefault(end.name, []).append(end)
        for name, here in by_name.items():
            sources = [each for each in here if each.kind is source_kind]
            targets = [each for each in here if each.kind is target_kind]
            yield PicturedLine(
                id=f"l{number}",
                kind=kind,
                name=name,
                types=tuple(dict.fromkeys(each.type for each in here)),
                sources=tuple(_pictured(basis, sources, nodes)),
                targets=tuple(_pictured(basis, targets, nodes)),
                arrows=tuple(_arrows(basis, name, sources, targets, nodes)),
            )
            number += 1


def _ends(basis: Basis) -> Iterable[_LineEnd]:
    for each in basis.view.actual:
        there = each.observed is not None
        actual = each.observed.type if each.observed else each.planned.type
        differs = () if actual == each.planned.type else (f"declared as {each.planned.type}",)
        error = (each.report.error,) if each.report and each.report.error else ()
        # With an observation, the flow beside it shows whether that is so.
        asked = tuple(_asked(each.node, each.planned)) if basis.verdict is None else ()
        yield _LineEnd(
            kind=each.planned.kind,
            name=each.planned.resolved,
            node=each.node.full_name,
            type=actual,
            presence=Presence.PRESENT if there else basis.absent,
            notes=(*differs, *error, *asked),
        )
    for other in (*basis.view.undeclared, *basis.view.foreign, *basis.view.unattributed):
        yield _LineEnd(
            kind=other.kind,
            name=other.name,
            node=other.node,
            type=other.type,
            presence=Presence.UNDECLARED,
        )


def _asked(node: PlannedNode, endpoint: PlannedEndpoint) -> Iterable[str]:
    """What an endpoint asks of its flow."""
    if endpoint.dscp is not None:
        yield describe(endpoint.dscp)
    if endpoint.unique is not UniqueRequirement.NOT_REQUIRED:
        yield f"unique {endpoint.unique.value}"
    if endpoint.five_qi is not None:
        yield f"5QI {endpoint.five_qi}"
    yield from (
        f"by {each.connection or each.name}"
        for each in node.participants
        if each.name == endpoint.participant
    )


def _pictured(
    basis: Basis, ends: Sequence[_LineEnd], nodes: Mapping[str, PicturedNode]
) -> Iterable[PicturedEnd]:
    """One end per node and presence: several endpoints of a node on one name are one end."""
    by_place: dict[tuple[str, Presence], list[_LineEnd]] = {}
    for each in ends:
        by_place.setdefault((each.node, each.presence), []).append(each)
    for (node, presence), same in by_place.items():
        several = (f"{len(same)} endpoints",) if len(same) > 1 else ()

        def concerns(finding: Finding, node: str = node, end: _LineEnd = same[0]) -> bool:
            return (
                finding.subject == end.name
                and finding.node in (node, "")
                and finding.endpoint in (end.kind, None)
            )

        yield PicturedEnd(
            node=nodes[node].id,
            presence=presence,
            notes=(*several, *dict.fromkeys(note for each in same for note in each.notes)),
            findings=basis.numbers(ends[0].name, concerns=concerns),
        )


def _arrows(
    basis: Basis,
    name: str,
    sources: Sequence[_LineEnd],
    targets: Sequence[_LineEnd],
    nodes: Mapping[str, PicturedNode],
) -> Iterable[PicturedArrow]:
    pairs: dict[tuple[str, str], tuple[_LineEnd, _LineEnd]] = {}
    for source in sources:
        for target in targets:
            pairs.setdefault((source.node, target.node), (source, target))
    for (source_name, target_name), (source, target) in pairs.items():
        found = {source.presence, target.presence}
        outcome = basis.outcome(name, source_name, target_name)
        differ = source.type != target.type
        yield PicturedArrow(
            source=nodes[source_name].id,
            target=nodes[target_name].id,
            presence=next(each for each in _WORST_FIRST if each in found),
            outcome=Outcome.VIOLATED if differ and outcome else outcome,
            notes=("types differ",) if differ else (),
        )


_WORST_FIRST = (Presence.MISSING, Presence.UNDECLARED, Presence.PRESENT, Presence.PLANNED)


OWN = "own participant"


def pictured_participants(
    basis: Basis, id_: str, name: str, presence: Presence
) -> tuple[PicturedParticipant, ...]:
    """Return a node's own participant, then every planned and every reported one.

    Args:
        basis: what the picture is drawn from.
        id_: of the node in the picture.
        name: of the node, fully qualified.
        presence: of the node.
    """
    planned = basis.view.planned.get(name)
    reported = _reported_participants(basis.view.configurations.get(name))
    own = (OWN, presence, planned.connections.urls if planned else ())
    found: dict[str, tuple[str, Presence, tuple[str, ...]]] = {}
    for each in planned.participants if planned else ():
        words = [each.reason, *each.connections.urls, *reported.get(each.name, ("", ()))[1]]
        if each.dscp is not None and describe(each.dscp) not in each.reason:
            words.append(describe(each.dscp))
        found[each.name] = (
            each.connection or each.name,
            Presence.PRESENT if each.name in reported else basis.absent,
            tuple(dict.fromkeys(filter(None, words))),
        )
    for base_name, (title, notes) in reported.items():
        found.setdefault(base_name, (title, Presence.UNDECLARED, notes))
    return tuple(
        PicturedParticipant(id=f"{id_}p{number}", node=id_, name=title, presence=where, notes=notes)
        for number, (title, where, notes) in enumerate((own, *found.values()))
    )


def _reported_participants(
    configuration: NodeConfiguration | None,
) -> dict[str, tuple[str, tuple[str, ...]]]:
    """Hidden participants that a node reports, by base name: title and notes."""
    reported: dict[str, tuple[str, tuple[str, ...]]] = {}
    for each in configuration.connections if configuration else ():
        if each.node_name:
            words = [*each.urls, "" if each.established else "not established", each.error]
            reported[each.node_name] = (each.name, tuple(filter(None, words)))
    for report in configuration.endpoints if configuration else ():
        if report.participant:
            reported.setdefault(report.participant, (report.participant, ()))
    return reported


def carrier(basis: Basis, node: PicturedNode, ends: Sequence[Actual]) -> PicturedParticipant:
    """Return what carries an end: as reported, else as planned, else the node's own."""
    for end in ends:
        reported = end.report.participant if end.report else ""
        if found := _participant(node, basis.view.planned.get(end.node.full_name), reported):
            return found
        if end.report is not None and end.report.connection:
            for each in node.participants:
                if each.name == end.report.connection:
                    return each
        if found := _participant(node, end.node, end.planned.participant):
            return found
    return node.participants[0]


def _participant(
    node: PicturedNode, planned: PlannedNode | None, base_name: str
) -> PicturedParticipant | None:
    if not base_name:
        return None
    extra = planned.participants if planned else ()
    titles = {each.name: each.connection or each.name for each in extra}
    title = titles.get(base_name, base_name)
    return next((each for each in node.participants if each.name == title), None)


_UNIQUE = {
    None: "uniqueness unknown",
    UniqueHow.NOT: "not unique",
    UniqueHow.WEAKLY: "weakly unique",
    UniqueHow.STRONGLY: "strongly unique",
}


def pictured_flows(basis: Basis, nodes: Mapping[str, PicturedNode]) -> tuple[PicturedFlow, ...]:
    """Return every planned flow in plan order, then every undeclared pair.

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
            flow.subject,
            flow.planned.topic,
            concerns=lambda each: (
                each.subject == flow.subject
                or (
                    each.subject == flow.planned.topic
                    and each.node in (flow.publisher, flow.subscription)
                )
            ),
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
    sides: dict[tuple[str, str, EndpointKind], list[SeenEndpoint]] = {}
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
