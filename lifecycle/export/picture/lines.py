"""The lines of a picture: topics, services and actions, and who is on them.

Owns: which ends and arrows a line has, and what is said of them. Pure.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence

from lifecycle.export.picture.basis import Basis
from lifecycle.export.picture.model import (
    LineKind,
    PicturedArrow,
    PicturedEnd,
    PicturedLine,
    PicturedNode,
    Presence,
)
from lifecycle.manifest.model import EndpointKind
from lifecycle.network.dscp import describe
from lifecycle.network.nfe import UniqueRequirement
from lifecycle.plan.model import PlannedEndpoint, PlannedNode
from lifecycle.verify.verdict import Finding, Outcome

_KINDS = (
    (LineKind.TOPIC, EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION),
    (LineKind.SERVICE, EndpointKind.SERVICE_CLIENT, EndpointKind.SERVICE_SERVER),
    (LineKind.ACTION, EndpointKind.ACTION_CLIENT, EndpointKind.ACTION_SERVER),
)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class _End:
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
        names = dict.fromkeys(e.name for e in ends if e.kind in (source_kind, target_kind))
        for name in names:
            here = [e for e in ends if e.name == name and e.kind in (source_kind, target_kind)]
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


def _ends(basis: Basis) -> Iterable[_End]:
    for each in basis.view.actual:
        there = each.observed is not None
        actual = each.observed.type if each.observed else each.planned.type
        differs = () if actual == each.planned.type else (f"declared as {each.planned.type}",)
        error = (each.report.error,) if each.report and each.report.error else ()
        # Where somebody looked, the flow tells beside it whether that is so.
        asked = tuple(_asked(each.node, each.planned)) if basis.verdict is None else ()
        yield _End(
            kind=each.planned.kind,
            name=each.planned.resolved,
            node=each.node.full_name,
            type=actual,
            presence=Presence.PRESENT if there else basis.absent,
            notes=(*differs, *error, *asked),
        )
    for other in (*basis.view.undeclared, *basis.view.foreign, *basis.view.unattributed):
        yield _End(
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
    basis: Basis, ends: Sequence[_End], nodes: Mapping[str, PicturedNode]
) -> Iterable[PicturedEnd]:
    """One end per node and presence: several endpoints of a node on one name are one end."""
    for node, presence in dict.fromkeys((each.node, each.presence) for each in ends):
        same = [each for each in ends if (each.node, each.presence) == (node, presence)]
        several = (f"{len(same)} endpoints",) if len(same) > 1 else ()

        def concerns(finding: Finding, node: str = node, end: _End = same[0]) -> bool:
            return (
                finding.subject == end.name
                and finding.node in (node, "")
                and finding.endpoint in (end.kind, None)
            )

        yield PicturedEnd(
            node=nodes[node].id,
            presence=presence,
            notes=(*several, *dict.fromkeys(note for each in same for note in each.notes)),
            findings=basis.numbers(concerns),
        )


def _arrows(
    basis: Basis,
    name: str,
    sources: Sequence[_End],
    targets: Sequence[_End],
    nodes: Mapping[str, PicturedNode],
) -> Iterable[PicturedArrow]:
    pairs: dict[tuple[str, str], tuple[_End, _End]] = {}
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
