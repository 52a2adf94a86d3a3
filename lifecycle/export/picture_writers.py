"""A picture as text, as Mermaid for Markdown, as SVG, and as one self-contained HTML page. Pure.

SVG has a column for each node, as wide as what is written in it and upright where there are many,
and a row for each topic, service or action. HTML needs no network and no other file, and nothing of
a graph is ever taken for markup; its script only hides what does not have the words of the filter.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping
from xml.sax.saxutils import escape, quoteattr

from lifecycle.export.picture import (
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
    classes = []
    for name, node in {_class(node): node for node in picture.nodes}.items():
        look, dash = STATES[node.state], DASHES.get(node.presence)
        dashed = f",stroke-width:2px,stroke-dasharray:{dash}" if dash else ""
        colour = LINES[node.presence]
        classes.append(
            f"  classDef {name} fill:{look.fill},color:{look.ink},stroke:{colour}{dashed}"
        )
    return "\n".join([*lines, *styles, *classes]) + "\n"


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


def _quoted(*said: str) -> str:
    """A quoted label of several lines; what Mermaid could read as syntax becomes an entity."""
    escaped = (re.sub(r"[^\w /.,:=()~+→-]", lambda m: f"#{ord(m[0])};", each) for each in said)
    return '"' + "<br/>".join(escaped) + '"'


_CHARACTER = 7.3
"""Width of a character of 12 px, pixels."""
_LINE = 15
_GAP = 14
_UPRIGHT_FROM = 9
"""Nodes from which on columns are upright."""

STYLE = """\
.lc text{font:12px ui-monospace,Menlo,Consolas,'DejaVu Sans Mono',monospace;fill:#1b2733}
.lc .quiet{font-size:10px;fill:#4d5a66}
.lc .head{font-weight:bold}
.lc .box{fill:#fff;stroke-width:1.6}
.lc .life{stroke:#c9d3df;stroke-width:1}
.lc .flow{fill:none;stroke-width:2}
.lc .unique{stroke-width:4}
.lc .violated{fill:#b3261e}
""" + "".join(
    f".lc .{each.value}{{stroke:{LINES[each]};stroke-dasharray:{DASHES.get(each, 'none')}}}\n"
    for each in Presence
)


def picture_to_svg(picture: Picture) -> str:
    """Return one drawing, complete in itself."""
    upright = len(picture.nodes) >= _UPRIGHT_FROM
    rows = [
        [f"{line.kind.value} {' ≠ '.join(line.types)}", *line_words(line)] for line in picture.lines
    ]
    quiet = _width([w for row in rows for w in row]) * 10 // 12
    left = max(quiet, _width([each.name for each in picture.lines]))
    boxes = [_box_words(node) for node in picture.nodes]
    sizes = [_width(box) if upright else len(box) * _LINE for box in boxes]
    tall = max(sizes, default=0) + _GAP
    drawn = [f'<text class="head" x="{_GAP}" y="20">{escaped(picture.title)}</text>']
    centres: dict[str, float] = {}
    x, top = float(left + 2 * _GAP), 34
    heights = [max(30, _LINE * (len(row) + 1) + 8) for row in rows]
    bottom = top + tall + _GAP + sum(heights)
    for node, box in zip(picture.nodes, boxes, strict=True):
        wide = len(box) * _LINE + _GAP if upright else max(_width(box) + _GAP, 80)
        centres[node.name] = x + wide / 2
        middle = f"{x + wide / 2:g}"
        drawn.append(
            f'<line class="life" x1="{middle}" y1="{top + tall}" x2="{middle}" y2="{bottom}"/>'
        )
        drawn += _drawn_column(node, box, (x, top, wide, tall), upright=upright)
        x += wide + _GAP
    y = top + tall + _GAP
    for line, row, height in zip(picture.lines, rows, heights, strict=True):
        drawn += _drawn_row(line, row, y, centres)
        y += height
    width, height, body = round(x + _GAP), round(bottom + _GAP), "\n".join(drawn)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" class="lc" role="img" width="{width}" '
        f'height="{height}" viewBox="0 0 {width} {height}" '
        f"aria-label={quoteattr(one_line(picture.title))}>\n"
        f'<style>{escape(STYLE)}</style>\n<rect width="100%" height="100%" fill="#fff"/>\n'
        f"{body}\n</svg>\n"
    )


def _box_words(node: PicturedNode) -> list[str]:
    state = f"{STATES[node.state].symbol} {node.state.value}"
    pid = f" · pid {node.pid}" if node.pid else ""
    where = ", ".join(filter(None, (node.machine, node.process and f"process {node.process}")))
    notes = words(node.presence, node.notes, node.findings)
    return [node.name, f"{state}{pid}", *([where] if where else []), *notes]


def _drawn_column(
    node: PicturedNode, box: list[str], area: tuple[float, float, float, float], *, upright: bool
) -> Iterator[str]:
    (x, y, wide, tall), look = area, STATES[node.state]
    along, down, turn = (tall, tall, " rotate(-90)") if upright else (wide, 0, "")
    yield '<g class="column">'
    yield (
        f'<rect class="box node {node.presence.value}" x="{x:g}" y="{y}" width="{wide:g}" '
        f'height="{tall:g}" rx="5"/>'
    )
    yield f'<g transform="translate({x:g} {y + down:g}){turn}">'
    bar = f'x="2" y="{_LINE + 5}" width="{along - 4:g}" height="{_LINE}"'
    yield f'<rect {bar} rx="3" style="fill:{look.fill}"/>'
    for number, said in enumerate(box):
        style = ("head", "", "quiet")[min(number, 2)]
        ink = f' style="fill:{look.ink}"' if number == 1 else ""
        place = f'x="7" y="{_LINE * (number + 1) + 1}"'
        yield f'<text class="{style}"{ink} {place}>{escaped(said)}</text>'
    yield "</g></g>"


def _drawn_row(
    line: PicturedLine, row: list[str], y: float, centres: dict[str, float]
) -> Iterator[str]:
    yield f'<g class="row"><text class="head" x="{_GAP}" y="{y + 12:g}">{escaped(line.name)}</text>'
    for number, said in enumerate(row, start=1):
        style = "quiet violated" if said.endswith("violated)") else "quiet"
        place = f'x="{_GAP + 8}" y="{y + 12 + _LINE * number:g}"'
        yield f'<text class="{style}" {place}>{escaped(said)}</text>'
    for number, flow in enumerate(line.flows):
        a, b, at = centres[flow.source], centres[flow.target], y + 8 + 4 * number
        unique = " unique" if flow.unique else ""
        yield f'<path class="flow {flow.presence.value}{unique}" d="M{a:g} {at:g}H{b:g}"/>'
    for end in line.sources:
        place = f'cx="{centres[end.node]:g}" cy="{y + 8:g}"'
        yield f'<circle {place} r="4" style="fill:{LINES[end.presence]}"/>'
    for end in line.targets:
        x = centres[end.node]
        points = f"{x - 5:g},{y + 2:g} {x + 6:g},{y + 8:g} {x - 5:g},{y + 14:g}"
        yield f'<polygon points="{points}" style="fill:{LINES[end.presence]}"/>'
    yield "</g>"


def _width(texts: list[str]) -> int:
    return round(max((len(one_line(each)) for each in texts), default=0) * _CHARACTER)


def escaped(said: str) -> str:
    """Return a text of others as one line of XML."""
    return escape(one_line(said))


CSS = """\
body{margin:0 1.5rem;font:15px/1.45 system-ui,sans-serif;color:#1b2733;background:#fff}
.verdict{display:inline-block;padding:.25rem .6rem;border-radius:.4rem;border:1px solid #8ea3bb}
.ok{background:#e3f4ee}.violated{background:#fbe9e7}.unverifiable{background:#fdf3dc}
.figure{overflow:auto;max-height:85vh;border:1px solid #dde4ec;border-radius:.4rem}
table{border-collapse:collapse;width:100%;font-size:.9rem}
th,td{padding:.35rem .6rem;text-align:left;vertical-align:top;border-bottom:1px solid #e6ebf1}
.gone{opacity:.15}
"""

SCRIPT = """\
"use strict";
var filter = document.getElementById("filter");
filter.parentElement.hidden = false;
filter.addEventListener("input", function () {
  var wanted = filter.value.trim().toLowerCase();
  document.querySelectorAll("tbody tr, svg g.row").forEach(function (row) {
    row.classList.toggle("gone", !row.textContent.toLowerCase().includes(wanted));
  });
});
"""


def picture_to_html(picture: Picture) -> str:
    """Return the whole page."""
    return "\n".join(_page(picture)) + "\n"


def _page(picture: Picture) -> Iterator[str]:
    yield '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">'
    yield (
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; '
        "style-src 'unsafe-inline'; script-src 'unsafe-inline'\">"
    )
    yield f"<title>{escaped(picture.title)}</title>\n<style>\n{CSS}</style>\n</head>\n<body>"
    if picture.verdict is not None:
        verdict = picture.verdict.value
        yield f'<p class="verdict {verdict}">{OUTCOMES[picture.verdict]} verdict {verdict}</p>'
    yield (
        '<p hidden><label for="filter">Show only what names </label>'
        '<input id="filter" type="search" autocomplete="off"></p>'
    )
    yield f'<div class="figure" tabindex="0">\n{picture_to_svg(picture)}</div>'
    if picture.findings:
        heads = ("no.", "outcome", "rule", "what", "where")
        head = "".join(f'<th scope="col">{each}</th>' for each in heads)
        yield f"<h2>Findings</h2>\n<table><thead><tr>{head}</tr></thead><tbody>"
        for number, finding in enumerate(picture.findings, start=1):
            hint = f"<br><em>{escaped(finding.hint)}</em>" if finding.hint else ""
            cells = (
                f"{OUTCOMES[finding.outcome]} {finding.outcome.value}",
                f"<code>{escaped(finding.rule)}</code>",
                f"{escaped(finding.message)}{hint}",
                f"<code>{escaped(finding.at)}</code>" if finding.at else "–",
            )
            rest = "".join(f"<td>{each}</td>" for each in cells)
            yield f'<tr><th scope="row">⚠{number}</th>{rest}</tr>'
        yield "</tbody></table>"
    yield f"<script>\n{SCRIPT}</script>\n</body>\n</html>"


WRITERS: Mapping[str, Callable[[Picture], str]] = {
    "text": picture_to_text,
    "mermaid": picture_to_mermaid,
    "svg": picture_to_svg,
    "html": picture_to_html,
}
"""What writes a picture, by the value of `--format`."""
