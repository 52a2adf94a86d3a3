"""A picture as SVG: a column for each node, a row for each topic, service or action. Pure.

Nothing overlaps however much there is: columns are as wide as what is written in them, and upright
where there are many.
"""

from __future__ import annotations

from collections.abc import Iterator
from xml.sax.saxutils import escape, quoteattr

from lifecycle.export.picture.model import (
    DASHES,
    LINES,
    STATES,
    Picture,
    PicturedFlow,
    PicturedLine,
    PicturedNode,
    Presence,
    words,
)
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
.lc .row.gone{opacity:.15}
""" + "".join(
    f".lc .{each.value}{{stroke:{LINES[each]};stroke-dasharray:{DASHES.get(each, 'none')}}}\n"
    for each in Presence
)


def picture_to_svg(picture: Picture) -> str:
    """Return one drawing, complete in itself."""
    body, width, height = _drawn(picture)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" class="lc" role="img" width="{width}" '
        f'height="{height}" viewBox="0 0 {width} {height}" aria-label={_quoted(picture.title)}>\n'
        f'<style>{escape(STYLE)}</style>\n<rect width="100%" height="100%" fill="#fff"/>\n'
        f"{body}\n</svg>\n"
    )


def _drawn(picture: Picture) -> tuple[str, int, int]:
    upright = len(picture.nodes) >= _UPRIGHT_FROM
    rows = [_row_words(line) for line in picture.lines]
    quiet = _width([w for row in rows for w in row]) * 10 // 12
    left = max(quiet, _width([each.name for each in picture.lines]))
    boxes = [_box_words(node) for node in picture.nodes]
    longest = max((_width(box) for box in boxes), default=0)
    deepest = max((len(box) for box in boxes), default=0) * _LINE + _GAP
    tall = longest + _GAP if upright else deepest
    drawn = [f'<text class="head" x="{_GAP}" y="20">{_text(picture.title)}</text>']
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
        drawn += _column(node, box, (x, top), (wide, tall), upright=upright)
        x += wide + _GAP
    y = top + tall + _GAP
    for line, row, height in zip(picture.lines, rows, heights, strict=True):
        drawn += _row(line, row, y, centres)
        y += height
    return "\n".join(drawn), round(x + _GAP), round(bottom + _GAP)


def _box_words(node: PicturedNode) -> list[str]:
    state = f"{STATES[node.state].symbol} {node.state.value}"
    pid = f" · pid {node.pid}" if node.pid else ""
    where = ", ".join(filter(None, (node.machine, node.process and f"process {node.process}")))
    notes = words(node.presence, node.notes, node.findings)
    return [node.name, f"{state}{pid}", *([where] if where else []), *notes]


def _column(
    node: PicturedNode,
    box: list[str],
    at: tuple[float, float],
    size: tuple[float, float],
    *,
    upright: bool,
) -> Iterator[str]:
    (x, y), (wide, tall), look = at, size, STATES[node.state]
    yield f'<g class="column"><title>{_text(" · ".join(box))}</title>'
    yield (
        f'<rect class="box node {node.presence.value}" x="{x:g}" y="{y}" width="{wide:g}" '
        f'height="{tall:g}" rx="5"/>'
    )
    if upright:
        bar = f'x="{x + _LINE + 5:g}" y="{y + 2}" width="{_LINE}" height="{tall - 4:g}"'
    else:
        bar = f'x="{x + 2:g}" y="{y + _LINE + 5}" width="{wide - 4:g}" height="{_LINE}"'
    yield f'<rect {bar} rx="3" style="fill:{look.fill}"/>'
    for number, said in enumerate(box):
        style = ("head", "", "quiet")[min(number, 2)]
        ink = f' style="fill:{look.ink}"' if number == 1 else ""
        down = _LINE * (number + 1) + 1
        place = f'x="{x + 7:g}" y="{y + down}"'
        if upright:
            place = f'transform="translate({x + down:g} {y + tall - 7:g}) rotate(-90)"'
        yield f'<text class="{style}"{ink} {place}>{_text(said)}</text>'
    yield "</g>"


def _row_words(line: PicturedLine) -> list[str]:
    said = [f"{line.kind.value} {' ≠ '.join(line.types)}"]
    for end in (*line.sources, *line.targets):
        notes = words(end.presence, end.notes, end.findings)
        said += [f"{end.node}: {', '.join(notes)}"] if notes else []
    if not line.sources or not line.targets:
        said.append(f"nobody {'subscribes or serves' if line.sources else 'publishes or calls'}")
    return [*said, *(_flow_words(flow) for flow in line.flows)]


def _flow_words(flow: PicturedFlow) -> str:
    outcome = f": {flow.outcome.value}" if flow.outcome else ""
    notes = ", ".join((flow.label, *flow.notes)).strip(", ")
    return f"{flow.source} → {flow.target}{outcome}{f' ({notes})' if notes else ''}"


def _row(line: PicturedLine, row: list[str], y: float, centres: dict[str, float]) -> Iterator[str]:
    yield f'<g class="row"><text class="head" x="{_GAP}" y="{y + 12:g}">{_text(line.name)}</text>'
    for number, said in enumerate(row, start=1):
        style = "quiet violated" if ": violated" in said else "quiet"
        place = f'x="{_GAP + 8}" y="{y + 12 + _LINE * number:g}"'
        yield f'<text class="{style}" {place}>{_text(said)}</text>'
    for number, flow in enumerate(line.flows):
        a, b, at = centres[flow.source], centres[flow.target], y + 8 + 4 * number
        unique = " unique" if flow.unique else ""
        yield (
            f'<path class="flow {flow.presence.value}{unique}" d="M{a:g} {at:g}H{b:g}">'
            f"<title>{_text(_flow_words(flow))}</title></path>"
        )
        if number == 0 and a != b:
            middle = f'x="{(a + b) / 2:g}" y="{at + 12:g}" text-anchor="middle"'
            yield f'<text class="quiet" {middle}>{_text(flow.label)}</text>'
    for ends, arrives in ((line.sources, False), (line.targets, True)):
        for end in ends:
            x, colour = centres[end.node], LINES[end.presence]
            shape = f'<circle cx="{x:g}" cy="{y + 8:g}" r="4" style="fill:{colour}"/>'
            if arrives:
                points = f"{x - 5:g},{y + 2:g} {x + 6:g},{y + 8:g} {x - 5:g},{y + 14:g}"
                shape = f'<polygon points="{points}" style="fill:{colour}"/>'
            yield shape
    yield "</g>"


def _width(texts: list[str]) -> int:
    return round(max((len(one_line(each)) for each in texts), default=0) * _CHARACTER)


def _text(said: str) -> str:
    return escape(one_line(said))


def _quoted(said: str) -> str:
    return quoteattr(one_line(said))
