"""The participants of a picture's nodes: as planned, as their nodes tell, and which carries what.

Owns: laying planned and reported participants side by side. Pure.
"""

from __future__ import annotations

from collections.abc import Sequence

from lifecycle.export.picture.basis import Basis
from lifecycle.export.picture.model import PicturedNode, PicturedParticipant, Presence
from lifecycle.network.dscp import describe
from lifecycle.plan.model import PlannedNode
from lifecycle.verify.observation import NodeConfiguration
from lifecycle.verify.view import Actual

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
    told = _told(basis.view.configurations.get(name))
    own = (OWN, presence, planned.connections.urls if planned else ())
    found: dict[str, tuple[str, Presence, tuple[str, ...]]] = {}
    for each in planned.participants if planned else ():
        words = [each.reason, *each.connections.urls, *told.get(each.name, ("", ()))[1]]
        if each.dscp is not None and describe(each.dscp) not in each.reason:
            words.append(describe(each.dscp))
        found[each.name] = (
            each.connection or each.name,
            Presence.PRESENT if each.name in told else basis.absent,
            tuple(dict.fromkeys(filter(None, words))),
        )
    for base_name, (title, notes) in told.items():
        found.setdefault(base_name, (title, Presence.UNDECLARED, notes))
    return tuple(
        PicturedParticipant(id=f"{id_}p{number}", node=id_, name=title, presence=where, notes=notes)
        for number, (title, where, notes) in enumerate((own, *found.values()))
    )


def _told(configuration: NodeConfiguration | None) -> dict[str, tuple[str, tuple[str, ...]]]:
    """Hidden participants that a node reports, by base name: title and notes."""
    told: dict[str, tuple[str, tuple[str, ...]]] = {}
    for each in configuration.connections if configuration else ():
        if each.node_name:
            words = [*each.urls, "" if each.established else "not established", each.error]
            told[each.node_name] = (each.name, tuple(filter(None, words)))
    for report in configuration.endpoints if configuration else ():
        if report.participant:
            told.setdefault(report.participant, (report.participant, ()))
    return told


def carrier(basis: Basis, node: PicturedNode, ends: Sequence[Actual]) -> PicturedParticipant:
    """Return what carries an end: as reported, else as planned, else the node's own."""
    for end in ends:
        told = end.report.participant if end.report else ""
        if found := _participant(node, basis.view.planned.get(end.node.full_name), told):
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
