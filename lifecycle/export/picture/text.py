"""A picture as text: plain, and Mermaid for Markdown. Pure."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator

from lifecycle.export.picture.model import (
    DASHES,
    LINES,
    STATES,
    LineKind,
    Picture,
    PicturedFlow,
    PicturedLine,
    PicturedNode,
    Presence,
)
from lifecycle.printable import columns, one_line
from lifecycle.verify.outcome import Outcome

_REMARKS = {
    Presence.MISSING: "declared, but missing",
    Presence.UNDECLARED: "there, but not declared",
}
"""Said beside what is not as declared."""

OUTCOMES = {Outcome.OK: "✓", Outcome.VIOLATED: "✗", Outcome.UNVERIFIABLE: "?"}
"""The symbol of each outcome."""

_ARROWS = {Presence.MISSING: "╌╌▷", Presence.UNDECLARED: "··▶"}


def picture_to_text(picture: Picture) -> str:
    """Return nodes, what is between them, and findings; what is not as declared says so."""
    return "\n".join(one_line(each).rstrip() for each in _document(picture)) + "\n"


def _document(picture: Picture) -> Iterator[str]:
    yield picture.title
    yield ""
    yield from columns([_row(node) for node in picture.nodes], indent=2)
    for line in picture.lines:
        yield ""
        yield f"  {line.kind.value} {line.name}  {' ≠ '.join(line.types)}"
        yield from (f"    {each}" for each in line_words(line))
    if picture.findings:
        yield ""
    for number, finding in enumerate(picture.findings, start=1):
        said = f"{OUTCOMES[finding.outcome]} {finding.outcome.value} {finding.rule}"
        yield f"  ⚠{number} {said}: {finding.message}"
        if finding.hint:
            yield f"      {finding.hint}"


def words(presence: Presence, notes: tuple[str, ...], findings: tuple[int, ...]) -> tuple[str, ...]:
    """Return all that is written beside something: its remark, its notes, `⚠1 ⚠4`."""
    remark = (_REMARKS[presence],) if presence in _REMARKS else ()
    warned = (" ".join(f"⚠{number}" for number in findings),) if findings else ()
    return (*remark, *notes, *warned)


def _row(node: PicturedNode) -> tuple[str, ...]:
    where = ", ".join(filter(None, (node.machine, node.process and f"process {node.process}")))
    return (
        f"{STATES[node.state].symbol} {one_line(node.name)}",
        node.state.value,
        f"pid {node.pid}" if node.pid else "",
        one_line(where),
        one_line(", ".join(words(node.presence, node.notes, node.findings))),
    )


def _flow(flow: PicturedFlow) -> str:
    said = [*filter(None, [flow.label]), *flow.notes]
    if flow.outcome not in (Outcome.OK, None):
        said.append(flow.outcome.value)
    return f"{flow.source} {_ARROWS.get(flow.presence, '──▶')} {flow.target}" + (
        f"  ({', '.join(said)})" if said else ""
    )


def line_words(line: PicturedLine) -> Iterator[str]:
    """Yield what is written below a line: its flows, and ends without one or with a remark."""
    yield from map(_flow, line.flows)
    joined = {name for flow in line.flows for name in (flow.source, flow.target)}
    for ends, form in ((line.sources, "{} ──▶ nobody"), (line.targets, "nobody ──▶ {}")):
        for end in ends:
            said = ", ".join(words(end.presence, end.notes, end.findings))
            shown = end.node if end.node in joined else form.format(end.node)
            if said or end.node not in joined:
                yield shown + (f"  ({said})" if said else "")


def picture_to_mermaid(picture: Picture) -> str:
    """Return one flowchart: nodes by machine, edges with their flows.

    States are colours and labels; missing is dashed and red, undeclared is dotted and orange; edges
    of unique flows are thick.
    """
    ids = {node.name: f"n{number}" for number, node in enumerate(picture.nodes)}
    lines = ["---", f"title: {json.dumps(one_line(picture.title))}", "---", "flowchart LR"]
    for number, machine in enumerate(dict.fromkeys(node.machine for node in picture.nodes)):
        inside = [f"    {_node(ids, n)}" for n in picture.nodes if n.machine == machine]
        frame = [f"  subgraph m{number}[{_quoted(machine)}]", *inside, "  end"]
        lines += frame if machine else inside
    styles: list[str] = []
    edges = list(_edges(picture, ids))
    for number, (edge, presence) in enumerate(edges):
        lines.append(f"  {edge}")
        if dash := DASHES.get(presence):
            styles.append(f"  linkStyle {number} stroke:{LINES[presence]},stroke-dasharray:{dash}")
    return "\n".join([*lines, *styles, *_classes(picture)]) + "\n"


def _node(ids: dict[str, str], node: PicturedNode) -> str:
    state = f"{STATES[node.state].symbol} {node.state.value}"
    said = words(node.presence, node.notes, node.findings)
    return f"{ids[node.name]}[{_quoted(node.name, state, *said)}]:::{_class(node)}"


def _edges(picture: Picture, ids: dict[str, str]) -> Iterator[tuple[str, Presence]]:
    """Every flow, and towards an empty circle each end without one."""
    stubs = 0
    for line in picture.lines:
        for flow in line.flows:
            arrow = "==>" if flow.unique else "-->" if line.kind is LineKind.TOPIC else "-.->"
            outcome = "" if flow.outcome in (Outcome.OK, None) else flow.outcome.value
            said = [each for each in (line.name, flow.label, *flow.notes, outcome) if each]
            edge = f"{ids[flow.source]} {arrow}|{_quoted(*said)}| {ids[flow.target]}"
            yield edge, flow.presence
        joined = {name for flow in line.flows for name in (flow.source, flow.target)}
        for ends, leaves in ((line.sources, True), (line.targets, False)):
            for end in (each for each in ends if each.node not in joined):
                stub = f"s{stubs}(( ))"
                stubs += 1
                a, b = (ids[end.node], stub) if leaves else (stub, ids[end.node])
                yield f"{a} -->|{_quoted(line.name)}| {b}", end.presence


def _class(node: PicturedNode) -> str:
    state = node.state.name.lower()
    return f"{node.presence.value}_{state}" if node.presence in DASHES else state


def _classes(picture: Picture) -> Iterator[str]:
    for name, node in {_class(node): node for node in picture.nodes}.items():
        look, dash = STATES[node.state], DASHES.get(node.presence)
        dashed = f",stroke-width:2px,stroke-dasharray:{dash}" if dash else ""
        colour = LINES[node.presence]
        yield f"  classDef {name} fill:{look.fill},color:{look.ink},stroke:{colour}{dashed}"


def _quoted(*said: str) -> str:
    """A quoted label of several lines; what Mermaid could read as syntax becomes an entity."""
    escaped = (re.sub(r"[^\w /.,:=()~+→-]", lambda m: f"#{ord(m[0])};", each) for each in said)
    return '"' + "<br/>".join(escaped) + '"'
