"""The two graphs of a picture as rows and columns.

Owns: what stands in which row and column: the computational graph has nodes and what they publish
and offer, the data layer graph participants and flows. Pure.
"""

from __future__ import annotations

from collections.abc import Iterable

from lifecycle.export.picture.look import PRESENCE_WORDS, STATES, numbers, remark
from lifecycle.export.picture.matrix import Column, Group, Mark, Row, Stroke
from lifecycle.export.picture.model import (
    LineKind,
    Picture,
    PicturedEnd,
    PicturedFlow,
    PicturedLine,
    PicturedNode,
    PicturedParticipant,
    Presence,
)
from lifecycle.export.picture.participants import OWN
from lifecycle.verify.verdict import Outcome


def computational(picture: Picture) -> tuple[tuple[Group, ...], tuple[Row, ...]]:
    """Return nodes as columns; topics, services and actions as rows."""
    groups = tuple(
        Group(
            title=machine.title,
            inner=tuple(
                (process.title, tuple(_node(node) for node in process.nodes))
                for process in machine.processes
            ),
        )
        for machine in picture.machines
    )
    names = {node.id: node.name for node in picture.nodes()}
    return groups, tuple(_line(line, names) for line in picture.lines)


def data_layer(picture: Picture) -> tuple[tuple[Group, ...], tuple[Row, ...]]:
    """Return participants as columns, those that carry or are told something; flows as rows."""
    used = {end for flow in picture.flows for end in (flow.publisher, flow.subscription)}
    groups = []
    for machine in picture.machines:
        inner = []
        for process in machine.processes:
            pids = dict.fromkeys(node.pid for node in process.nodes if node.pid)
            pid = f", pid {', '.join(map(str, pids))}" if pids else ""
            title = (process.title or f"process {process.nodes[0].process}".rstrip()) + pid
            columns = tuple(
                _participant(node, each)
                for node in process.nodes
                for each in node.participants
                if each.id in used or each.name != OWN or each.notes or len(node.participants) == 1
            )
            inner.append((title if process.nodes[0].process else "", columns))
        groups.append(Group(title=machine.title, inner=tuple(inner)))
    return tuple(groups), tuple(_flow(flow) for flow in picture.flows)


def _node(node: PicturedNode) -> Column:
    warned = numbers(node.findings)
    return Column(
        id=node.id,
        title=node.name,
        badge=_badge(node),
        notes=(*node.notes, *((warned,) if warned else ())),
        style=f"node {node.presence.value}",
        badge_style=f"s-{node.state.name.lower()}",
    )


def _badge(node: PicturedNode) -> str:
    state = f"{STATES[node.state].symbol} {node.state.value}"
    if node.presence is Presence.MISSING:
        return f"{state}: missing"
    return f"{state} · pid {node.pid}" if node.pid else state


def _participant(node: PicturedNode, participant: PicturedParticipant) -> Column:
    return Column(
        id=participant.id,
        title=node.name,
        badge=participant.name,
        notes=(*remark(participant.presence), *participant.notes),
        style=f"participant {participant.presence.value}",
        badge_style="s-participant",
    )


def _line(line: PicturedLine, names: dict[str, str]) -> Row:
    notes = [(f"{line.kind.value} {' ≠ '.join(line.types)}", "quiet")]
    ends = [*((e, False) for e in line.sources), *((e, True) for e in line.targets)]
    for end, _ in ends:
        if not end.presence.as_declared or end.notes or end.findings:
            notes.append((_said(end, names), f"quiet {end.presence.value}"))
    if not (line.sources and line.targets):
        notes.append((_NOBODY[line.kind, bool(line.targets)], "quiet alone"))
    return Row(
        id=line.id,
        title=line.name,
        notes=tuple(notes),
        style=f"line {line.kind.value} {line.presence.value}",
        marks=tuple(
            Mark(
                column=end.node,
                arrives=arrives,
                style=end.presence.value,
                words=f"{_said(end, names)} · {line.name}",
            )
            for end, arrives in ends
        ),
        strokes=tuple(
            Stroke(
                source=arrow.source,
                target=arrow.target,
                style=f"{arrow.presence.value} {line.kind.value} {_outcome(arrow.outcome)}",
                words=f"{names[arrow.source]} → {names[arrow.target]}: "
                f"{_told(arrow.presence, arrow.outcome)}",
            )
            for arrow in line.arrows
        ),
    )


_NOBODY = {
    (LineKind.TOPIC, False): "nobody subscribes to it",
    (LineKind.TOPIC, True): "nobody publishes it",
    (LineKind.SERVICE, False): "nobody serves it",
    (LineKind.SERVICE, True): "nobody calls it",
    (LineKind.ACTION, False): "nobody serves it",
    (LineKind.ACTION, True): "nobody calls it",
}
"""Who is missing, by whether there is a target."""


def _said(end: PicturedEnd, names: dict[str, str]) -> str:
    words = end_words(end)
    return f"{names[end.node]}: {', '.join(words)}" if words else names[end.node]


def end_words(end: PicturedEnd) -> tuple[str, ...]:
    """Return what is said of an end beside its node's name."""
    return (*remark(end.presence), *end.notes, *filter(None, [numbers(end.findings)]))


def _told(presence: Presence, outcome: Outcome | None) -> str:
    return ", ".join([PRESENCE_WORDS[presence], *([outcome.value] if outcome else [])])


def _flow(flow: PicturedFlow) -> Row:
    return Row(
        id=flow.id,
        title=flow.topic,
        notes=tuple(_flow_notes(flow)),
        style=f"flow {flow.presence.value}",
        marks=(
            Mark(
                column=flow.publisher,
                arrives=False,
                style=flow.presence.value,
                words=f"{flow.names[0]} publishes {flow.topic}",
            ),
            Mark(
                column=flow.subscription,
                arrives=True,
                style=flow.presence.value,
                words=f"{flow.names[1]} subscribes to {flow.topic}",
            ),
        ),
        strokes=(
            Stroke(
                source=flow.publisher,
                target=flow.subscription,
                style=f"{flow.presence.value} {_outcome(flow.outcome)}"
                f"{' unique' if is_unique(flow) else ''}",
                words=f"{' → '.join(flow.names)}: {_told(flow.presence, flow.outcome)}",
                label=edge_label(flow),
            ),
        ),
    )


def edge_label(flow: PicturedFlow) -> str:
    """What stands on the edge of a flow: medium, DSCP, uniqueness; or that it is not there.

    How unique a planned flow is to be stands among its demands.
    """
    if flow.presence is Presence.MISSING:
        return "missing"
    dscp = flow.dscp.split(" = ", maxsplit=1)[0]
    known = flow.presence is not Presence.PLANNED and flow.unique != "uniqueness unknown"
    words = [flow.medium, dscp, flow.unique if known else ""]
    if flow.presence is Presence.UNDECLARED:
        words = ["not declared"]
    return " · ".join(filter(None, words))


def _flow_notes(flow: PicturedFlow) -> Iterable[tuple[str, str]]:
    yield " → ".join(flow.names), "quiet"
    for each in remark(flow.presence):
        yield each, f"quiet {flow.presence.value}"
    if flow.presence is Presence.PLANNED:
        if flow.dscp:
            yield flow.dscp, "quiet"
    elif flow.presence is not Presence.UNDECLARED:
        planned = f", planned {flow.planned}" if flow.planned not in ("", flow.medium) else ""
        yield (
            f"{flow.medium}{planned} · {flow.dscp or 'no DSCP read back'} · {flow.unique}",
            "quiet",
        )
    for each in flow.tuples:
        yield each, "quiet"
    if flow.demands:
        yield f"asked for: {', '.join(flow.demands)}", "quiet"
    if flow.outcome is not None and (flow.outcome is not Outcome.OK or flow.findings):
        said = f"{flow.outcome.value} {numbers(flow.findings)}".rstrip()
        yield said, f"quiet {_outcome(flow.outcome)}"


def _outcome(outcome: Outcome | None) -> str:
    return f"o-{outcome.value}" if outcome else "o-none"


def is_unique(flow: PicturedFlow) -> bool:
    """Tell whether a flow is drawn thick."""
    return flow.unique in ("weakly unique", "strongly unique")
