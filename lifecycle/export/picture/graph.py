"""Nodes, frames and edge labels that the DOT and Mermaid graphs of a picture share.

Owns: the texts, and which edges there are; each language's module owns its spelling. Both lay out
by themselves, so one graph shows what rows and columns show in two. Pure.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator

from lifecycle.export.picture.lines import OWN
from lifecycle.export.picture.model import (
    STATES,
    LineKind,
    Picture,
    PicturedArrow,
    PicturedFlow,
    PicturedLine,
    PicturedNode,
    Presence,
    numbers,
    remark,
)
from lifecycle.export.picture.views import edge_label, is_unique, wrapped
from lifecycle.verify import Outcome

_LABEL_CHARACTERS = 60


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Edge:
    """What goes from one node to another, or nowhere.

    Attributes:
        source: node id; empty if there is none.
        target: likewise.
        words: one line each.
        unique: its flow is, or in the picture of a plan is to be.
    """

    source: str
    target: str
    kind: LineKind
    presence: Presence
    words: tuple[str, ...]
    unique: bool = False


def framed(
    picture: Picture,
    opening: Callable[[str, str], str],
    closing: str,
    node: Callable[[PicturedNode], str],
) -> Iterator[str]:
    """Yield the nodes in the frames of their machines and processes, indented.

    Args:
        picture: whose nodes.
        opening: from the id and the title of a frame to what opens it.
        closing: what closes it.
        node: what a node is.
    """
    for m, machine in enumerate(picture.machines):
        yield f"  {opening(f'm{m}', machine.title)}"
        for p, process in enumerate(machine.processes):
            inner = [f"    {node(each)}" for each in process.nodes]
            if process.title:
                yield f"    {opening(f'm{m}p{p}', process.title)}"
                yield from (f"  {each}" for each in inner)
                yield f"    {closing}"
            else:
                yield from inner
        yield f"  {closing}"


def node_words(node: PicturedNode) -> tuple[str, ...]:
    """Return the text in a node: name, state, participants that are not ordinary, findings."""
    words = [f"{STATES[node.state].symbol} {node.state.value}"]
    words += remark(node.presence) if node.presence is Presence.MISSING else ()
    words += node.notes
    for each in node.participants:
        said = [*(remark(each.presence) if each.presence is not node.presence else ()), *each.notes]
        if said or each.name != OWN:
            words.append(f"{each.name}: {', '.join(said)}" if said else each.name)
    words += filter(None, [numbers(node.findings)])
    return (node.name, *wrapped(words, _LABEL_CHARACTERS))


def edges(picture: Picture) -> Iterator[Edge]:
    """Yield every arrow, and an edge to nowhere for each end without one."""
    flows = {(flow.topic, *flow.names): flow for flow in picture.flows}
    names = {node.id: node.name for node in picture.nodes()}
    carriers = {each.id: each.name for node in picture.nodes() for each in node.participants}
    for line in picture.lines:
        for arrow in line.arrows:
            flow = flows.get((line.name, names[arrow.source], names[arrow.target]))
            yield Edge(
                source=arrow.source,
                target=arrow.target,
                kind=line.kind,
                presence=arrow.presence,
                words=_arrow_words(line, arrow, flow, carriers),
                unique=flow is not None and is_unique(flow),
            )
        for end in line.alone:
            leaves = end in line.sources
            yield Edge(
                source=end.node if leaves else "",
                target="" if leaves else end.node,
                kind=line.kind,
                presence=end.presence,
                words=(line.name, *remark(end.presence), *end.notes),
            )


def _arrow_words(
    line: PicturedLine, arrow: PicturedArrow, flow: PicturedFlow | None, carriers: dict[str, str]
) -> tuple[str, ...]:
    words = [line.name, *remark(arrow.presence)]
    if flow is not None:
        if arrow.presence.as_declared:
            words += [edge_label(flow), *flow.demands]
            carried = dict.fromkeys(carriers[end] for end in (flow.publisher, flow.subscription))
            words += [f"by {each}" for each in carried if each != OWN]
        if flow.outcome not in (Outcome.OK, None):
            words.append(flow.outcome.value)
    return tuple(filter(None, dict.fromkeys([*words, *arrow.notes])))
