"""A picture as text: plain, and Mermaid for Markdown. Pure.

Owns: the lines of the plain one; nodes, frames and edge labels of the graph, which lays itself
out, and its syntax and escapes. One graph shows what rows and columns show in
two.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator

from lifecycle import dataclasses
from lifecycle.export.picture.lines import OWN
from lifecycle.export.picture.model import (
    DASHES,
    LINES,
    OUTCOMES,
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
from lifecycle.export.picture.views import edge_label, end_words, is_unique, wrapped
from lifecycle.printable import one_line
from lifecycle.verify import Outcome

_ARROWS = {
    Presence.PRESENT: "──▶",
    Presence.MISSING: "╌╌▷",
    Presence.UNDECLARED: "··▶",
    Presence.PLANNED: "──▶",
}


def picture_to_text(picture: Picture) -> str:
    """Return both graphs and the findings; every element that is not as declared says so."""
    return "\n".join(map(str.rstrip, _document(picture))) + "\n"


def _document(picture: Picture) -> Iterator[str]:
    yield one_line(picture.title)
    yield ""
    yield "computational graph"
    names = {node.id: node.name for node in picture.nodes()}
    rows = [_node(node) for node in picture.nodes()]
    yield from _columns(rows, indent="  ")
    for line in picture.lines:
        yield from _line(line, names)
    yield ""
    yield "data layer graph"
    for machine in picture.machines:
        yield one_line(f"  {machine.title}")
        for process in machine.processes:
            for node in process.nodes:
                yield from _participants(node, process.title)
    if picture.flows:
        yield "  flows"
    yield from _columns([_flow(flow) for flow in picture.flows], indent="    ")
    if picture.findings:
        yield ""
        yield "findings"
    for finding in picture.findings:
        symbol = OUTCOMES[finding.outcome].symbol
        yield f"  ⚠{finding.number} {symbol} {finding.outcome.value} {finding.rule}: " + one_line(
            finding.message
        )
        if finding.hint:
            yield f"      {one_line(finding.hint)}"


def _node(node: PicturedNode) -> tuple[str, ...]:
    pid = f"pid {node.pid}" if node.pid else ""
    where = remark(node.presence)
    notes = [*where, *(each for each in node.notes if not where or each != "not declared")]
    return (
        f"{STATES[node.state].symbol} {one_line(node.name)}",
        node.state.value,
        pid,
        " ".join(filter(None, [one_line(", ".join(notes)), numbers(node.findings)])),
    )


def _line(line: PicturedLine, names: dict[str, str]) -> Iterator[str]:
    yield f"  {line.kind.value} {one_line(line.name)}  {one_line(' ≠ '.join(line.types))}"
    for arrow in line.arrows:
        yield f"    {_arrow(arrow, names)}"
    alone = line.alone
    for ends, before, after in (
        (line.sources, "", " ──▶ nobody"),
        (line.targets, "nobody ──▶ ", ""),
    ):
        for end in ends:
            words = end_words(end)
            said = f"  ({one_line(', '.join(words))})" if words else ""
            if end in alone:
                yield f"    {before}{one_line(names[end.node])}{after}{said}"
            elif said:
                yield f"      {one_line(names[end.node])}{said}"


def _arrow(arrow: PicturedArrow, names: dict[str, str]) -> str:
    words = [*arrow.notes, *remark(arrow.presence)]
    if arrow.outcome not in (Outcome.OK, None):
        words.append(arrow.outcome.value)
    said = one_line(f"  ({', '.join(words)})") if words else ""
    return (
        f"{one_line(names[arrow.source])} {_ARROWS[arrow.presence]} "
        f"{one_line(names[arrow.target])}{said}"
    )


def _participants(node: PicturedNode, process: str) -> Iterator[str]:
    where = [process or (f"process {node.process}" if node.process else "")]
    where += [f"pid {node.pid}"] if node.pid else []
    said = f"  {', '.join(filter(None, where))}" if any(where) else ""
    yield f"    {one_line(node.name)}{one_line(said)}"
    for each in node.participants:
        words = [*remark(each.presence), *each.notes]
        if len(node.participants) > 1 or words:
            gap = "  " if words else ""
            yield f"      {one_line(each.name)}{gap}{one_line(', '.join(words))}"


def _flow(flow: PicturedFlow) -> tuple[str, ...]:
    judged = flow.outcome if flow.presence is not Presence.UNDECLARED else None
    outcome = judged.value if judged else ""
    return (
        one_line(flow.topic),
        f"{one_line(flow.names[0])} {_ARROWS[flow.presence]} {one_line(flow.names[1])}",
        edge_label(flow),
        ", ".join(flow.tuples),
        ", ".join(flow.demands),
        f"{outcome} {numbers(flow.findings)}".strip(),
    )


def _columns(rows: Iterable[tuple[str, ...]], *, indent: str) -> Iterator[str]:
    table = list(rows)
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    for row in table:
        cells = (cell.ljust(width) for cell, width in zip(row, widths, strict=True) if width)
        yield indent + "  ".join(cells)


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


def picture_to_mermaid(picture: Picture) -> str:
    """Return one flowchart: nodes by machine and process, edges with their flows.

    States are colours and labels; missing is dashed and red, undeclared is dotted and orange; edges
    of unique flows are thick.
    """
    lines = ["---", f"title: {json.dumps(picture.title)}", "---", "flowchart LR"]
    lines += framed(picture, _mermaid_opening, "end", _mermaid_node)
    styles: list[str] = []
    for number, edge in enumerate(edges(picture)):
        lines.append(f"  {_mermaid_edge(edge, f's{number}(( ))')}")
        if dash := DASHES[edge.presence]:
            styles.append(
                f"  linkStyle {number} stroke:{LINES[edge.presence]},stroke-dasharray:{dash}"
            )
    return "\n".join([*lines, *styles, *_classes(picture)]) + "\n"


def _mermaid_opening(id_: str, title: str) -> str:
    return f"subgraph {id_}[{_mermaid_quoted(title)}]"


def _mermaid_node(node: PicturedNode) -> str:
    return f"{node.id}[{_mermaid_quoted(*node_words(node))}]:::{_class(node)}"


def _mermaid_edge(edge: Edge, stub: str) -> str:
    """An end without an opposite is drawn towards an empty circle."""
    arrow = "==>" if edge.unique else "-->" if edge.kind is LineKind.TOPIC else "-.->"
    return f"{edge.source or stub} {arrow}|{_mermaid_quoted(*edge.words)}| {edge.target or stub}"


def _class(node: PicturedNode) -> str:
    state = node.state.name.lower()
    return state if node.presence.as_declared else f"{node.presence.value}_{state}"


def _classes(picture: Picture) -> Iterator[str]:
    """The classes that the picture uses."""
    for name, node in {_class(node): node for node in picture.nodes()}.items():
        look = STATES[node.state]
        dash = DASHES[node.presence]
        dashed = f",stroke-width:2px,stroke-dasharray:{dash}" if dash else ""
        colour = LINES[node.presence]
        yield f"  classDef {name} fill:{look.fill},color:{look.ink},stroke:{colour}{dashed}"


def _mermaid_quoted(*words: str) -> str:
    """A quoted label of several lines; what Mermaid could read as syntax becomes an entity."""
    return '"' + "<br/>".join(map(_mermaid_escape, words)) + '"'


def _mermaid_escape(word: str) -> str:
    return re.sub(r"[^\w /.,:=()~+→-]", lambda match: f"#{ord(match[0])};", word)
