"""A picture as SVG: a column for each node, a row for each topic, service or action. Pure.

Columns are as wide as what is written in them, and upright where there are many.
"""

from __future__ import annotations

from collections.abc import Iterator
from xml.sax.saxutils import escape, quoteattr

from lifecycle.export.picture.model import (
    DASHES,
    LINES,
    STATES,
    Picture,
    PicturedLine,
    PicturedNode,
    Presence,
)
from lifecycle.export.picture.text import line_words, words
from lifecycle.printable import one_line

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
        drawn += _column(node, box, (x, top, wide, tall), upright=upright)
        x += wide + _GAP
    y = top + tall + _GAP
    for line, row, height in zip(picture.lines, rows, heights, strict=True):
        drawn += _row(line, row, y, centres)
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


def _column(
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


def _row(line: PicturedLine, row: list[str], y: float, centres: dict[str, float]) -> Iterator[str]:
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
