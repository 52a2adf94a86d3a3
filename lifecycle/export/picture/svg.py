"""A picture as SVG that a person can read, alone or within a page. Owns how it is drawn. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from xml.sax.saxutils import escape, quoteattr

from lifecycle.export.picture.model import (
    DASHES,
    LINES,
    OUTCOMES,
    PRESENCE_WORDS,
    STATES,
    Picture,
    PicturedNodeState,
    Presence,
)
from lifecycle.export.picture.views import (
    LINE,
    MARGIN,
    QUIET_EM,
    Placed,
    PlacedColumn,
    PlacedRow,
    Stroke,
    computational,
    data_layer,
    place,
    text_width,
)
from lifecycle.printable import one_line
from lifecycle.verify import Outcome

_INK, _QUIET = "#1b2733", "#4d5a66"
_TINTS = ("#f1f5fb", "#fbf6ec")
_SECTION_GAP = 36
HEADING = 24
_LEGEND_WIDTH = 900
HEADINGS = ("Computational graph", "Data layer graph")


def style() -> str:
    """Return the CSS that the figures of a picture need."""
    rules = [
        (
            ".lc-figure text{font-family:ui-monospace,Menlo,Consolas,'DejaVu Sans Mono',monospace;"
            f"font-size:12px;fill:{_INK}}}"
        ),
        f".lc-figure .quiet{{font-size:{QUIET_EM}px;fill:{_QUIET}}}",
        ".lc-figure .head{font-weight:bold}",
        ".lc-figure .title{font-size:15px;font-weight:bold}",
        ".lc-figure .box{fill:#fff;stroke-width:1.6}",
        ".lc-figure .row-back{fill:transparent}",
        ".lc-figure .row:hover .row-back,.lc-figure .row.lit .row-back{fill:#fff3c4}",
        ".lc-figure .row.dim,.lc-figure .row.faint,.lc-figure .column.dim{opacity:.18}",
        ".lc-figure .stroke{fill:none;stroke-width:2}",
        ".lc-figure .stroke.unique{stroke-width:4}",
        ".lc-figure .stroke.service,.lc-figure .stroke.action{stroke-width:1.4}",
        ".lc-figure .halo{paint-order:stroke;stroke:#fff;stroke-width:4px}",
        ".lc-figure .s-participant{fill:#e3e8ee}",
        f".lc-figure .topic.planned .alone{{fill:{LINES[Presence.MISSING]};font-weight:bold}}",
    ]
    for presence in Presence:
        colour, dash = LINES[presence], DASHES[presence]
        dashed = f";stroke-dasharray:{dash}" if dash else ""
        name = presence.value
        rules += [
            f".lc-figure .{name}.box,.lc-figure .{name}.stroke{{stroke:{colour}{dashed}}}",
            f".lc-figure .{name}.mark{{fill:{colour}}}",
        ]
        if not presence.as_declared:
            rules.append(f".lc-figure text.{name}{{fill:{colour};font-weight:bold}}")
    for state, look in STATES.items():
        rules.append(f".lc-figure .s-{state.name.lower()}{{fill:{look.fill}}}")
        rules.append(f".lc-figure text.t-{state.name.lower()}{{fill:{look.ink}}}")
    for outcome in (Outcome.VIOLATED, Outcome.UNVERIFIABLE):
        ink = {Outcome.VIOLATED: "#b3261e", Outcome.UNVERIFIABLE: "#8a5a00"}[outcome]
        rules.append(f".lc-figure text.o-{outcome.value}{{fill:{ink};font-weight:bold}}")
    return "\n".join(rules)


def picture_to_svg(picture: Picture) -> str:
    """Return both graphs and a legend as one SVG document without external references."""
    figures = [place(*computational(picture)), place(*data_layer(picture))]
    legend_height, legend_lines = _legend(_legend_entries(picture), heading="Legend")
    width = max(_LEGEND_WIDTH, *(each.width for each in figures)) + 2 * MARGIN
    body: list[str] = []
    y = MARGIN + 40
    for heading, placed in zip(HEADINGS, figures, strict=True):
        body.append(f'<g transform="translate({MARGIN} {y})">')
        body += _figure(heading, placed)
        body.append("</g>")
        y += placed.height + _SECTION_GAP
    body += [f'<g transform="translate({MARGIN} {y})">', *legend_lines, "</g>"]
    height = y + legend_height + MARGIN
    return "\n".join(
        [
            (
                f'<svg xmlns="http://www.w3.org/2000/svg" class="lc-figure" width="{width}" '
                f'height="{height}" viewBox="0 0 {width} {height}" role="img">'
            ),
            f"<title>{_escape(picture.title)}</title>",
            f"<style>{escape(style())}</style>",
            f'<rect width="{width}" height="{height}" fill="#ffffff"/>',
            _text(MARGIN, MARGIN + 14, picture.title, "title"),
            *body,
            "</svg>",
            "",
        ]
    )


def figure_svg(heading: str, placed: Placed) -> str:
    """Return one graph as an SVG element for a page that brings `style` itself."""
    # There is no heading in it: the page has its own.
    width, height = placed.width + 2 * MARGIN, placed.height + MARGIN - HEADING
    return "\n".join(
        [
            (
                f'<svg xmlns="http://www.w3.org/2000/svg" class="lc-figure" width="{width}" '
                f'height="{height}" viewBox="0 0 {width} {height}" role="img" '
                f"aria-label={_attribute(heading)}>"
            ),
            f'<g transform="translate({MARGIN} {-HEADING})">',
            *_figure("", placed),
            "</g>",
            "</svg>",
        ]
    )


def legend_svg(picture: Picture) -> str:
    """Return the legend as an SVG element for a page that brings `style` itself."""
    height, lines = _legend(_legend_entries(picture), heading="")
    width = _LEGEND_WIDTH + 2 * MARGIN
    return "\n".join(
        [
            (
                f'<svg xmlns="http://www.w3.org/2000/svg" class="lc-figure legend" width="{width}" '
                f'height="{height}" viewBox="0 0 {width} {height}" role="img" aria-label="Legend">'
            ),
            f'<g transform="translate({MARGIN} {-HEADING // 2})">',
            *lines,
            "</g>",
            "</svg>",
        ]
    )


def _figure(heading: str, placed: Placed) -> Iterator[str]:
    if heading:
        yield _text(0, 16, heading, "title")
    for number, frame in enumerate(placed.machines):
        fill = _TINTS[number % len(_TINTS)]
        yield _rect(frame.x, frame.y, frame.width, frame.height, f'fill="{fill}" stroke="#c9d3df"')
        yield _text(frame.x + 8, frame.y + 16, frame.title, "head")
    for frame in placed.processes:
        yield _rect(frame.x, frame.y, frame.width, frame.height, 'fill="none" stroke="#8ea3bb"')
        yield _text(frame.x + 6, frame.y + 14, frame.title, "quiet")
    for column in placed.columns:
        yield from _column(column, placed)
    centres = {column.column.id: column.centre for column in placed.columns}
    for row in placed.rows:
        yield from _row(row, centres, placed)


def _column(placed: PlacedColumn, whole: Placed) -> Iterator[str]:
    column, x, y = placed.column, placed.x, placed.y
    bottom = y + placed.height
    yield f'<g class="column" data-column={_attribute(column.id)}>'
    yield f"<title>{_escape(' · '.join([column.title, column.badge, *placed.notes]))}</title>"
    yield (
        f'<path d="M{placed.centre} {bottom}V{whole.height}" stroke="#aab7c6" '
        'stroke-dasharray="1 4"/>'
    )
    yield _rect(x, y, placed.width, placed.height, f'class="box {column.style}"')
    name = column.badge_style.removeprefix("s-")
    lines = [(column.title, "head"), (column.badge, f"quiet t-{name}")]
    lines += [(note, "quiet") for note in placed.notes]
    if whole.upright:
        yield _rect(x + 22, y + 4, 16, placed.height - 8, f'class="{column.badge_style}"')
        for number, (words, class_) in enumerate(lines):
            at = x + 16 + (18 if number else 0) + (LINE - 1) * max(0, number - 1)
            yield (
                f'<text x="{at}" y="{bottom - 8}" class="{class_}" '
                f'transform="rotate(-90 {at} {bottom - 8})">{_escape(words)}</text>'
            )
    else:
        yield _rect(x + 6, y + 22, placed.width - 12, 16, f'class="{column.badge_style}"')
        for number, (words, class_) in enumerate(lines):
            at = y + 16 + (18 if number else 0) + (LINE - 1) * max(0, number - 1)
            yield _text(placed.centre, at, words, class_, anchor="middle")
    yield "</g>"


def _row(placed: PlacedRow, centres: dict[str, int], whole: Placed) -> Iterator[str]:
    row, y = placed.row, placed.y
    ends = " ".join(dict.fromkeys(mark.column for mark in row.marks))
    yield (
        f'<g class="row {row.style}" data-row={_attribute(row.id)} data-columns={_attribute(ends)}>'
    )
    yield f'<rect class="row-back" x="0" y="{y}" width="{whole.width}" height="{placed.height}"/>'
    yield f'<path d="M0 {y}H{whole.width}" stroke="#dde4ec"/>'
    presence = next(each for each in Presence if each.value in row.style.split())
    tone = "" if presence is Presence.PRESENT else f" {presence.value}"
    yield _text(0, y + 16, row.title, f"head{tone}")
    for number, (words, class_) in enumerate(placed.notes):
        yield _text(0, y + 30 + (LINE - 1) * number, words, class_)
    for stroke in row.strokes:
        yield from _stroke(stroke, placed.centre, centres)
    for mark in row.marks:
        x, at = centres[mark.column], placed.centre
        words = f"<title>{_escape(mark.words)}</title>"
        if mark.arrives:
            others = [centres[e.source] for e in row.strokes if e.target == mark.column]
            side = -1 if min((each - x for each in others if each != x), default=-1) < 0 else 1
            tip, back = x + side * 2, x + side * 12
            path = f"M{tip} {at}L{back} {at - 6}V{at + 6}Z"
            yield f'<path class="mark {mark.style}" d="{path}">{words}</path>'
        else:
            yield f'<circle class="mark {mark.style}" cx="{x}" cy="{at}" r="5">{words}</circle>'
    yield "</g>"


def _stroke(stroke: Stroke, y: int, centres: dict[str, int]) -> Iterator[str]:
    start, end = centres[stroke.source], centres[stroke.target]
    inside = 8 if end < start else -8  # so that a thick stroke does not blunt the arrowhead
    path = f"M{start} {y}H{end + inside}" if start != end else f"M{start} {y}c26 -16 26 16 8 2"
    words = f"<title>{_escape(stroke.words)}</title>"
    yield f'<path class="stroke {stroke.style}" d="{path}">{words}</path>'
    if stroke.label:
        middle = (start + end) // 2 if start != end else start + 30
        room = abs(end - start) >= text_width(stroke.label, QUIET_EM) + 16
        anchor = "middle" if room or start == end else "start"
        x = middle if anchor == "middle" else max(start, end) + 14
        at = y - 6 if anchor == "middle" else y + 3
        outcome = next((each for each in stroke.style.split() if each.startswith("o-")), "")
        presence = next(each for each in Presence if each.value in stroke.style.split())
        tone = outcome if presence.as_declared else presence.value
        yield _text(x, at, stroke.label, f"quiet halo {tone}".rstrip(), anchor=anchor)


def _legend_entries(picture: Picture) -> Iterator[tuple[str, str]]:
    """(drawing of 24×16 pixels, words)."""
    plan = picture.verdict is None
    # What runs may change from one picture to the next, and a missing node is said as missing.
    states = set(PicturedNodeState) - {PicturedNodeState.ABSENT, PicturedNodeState.MANAGED}
    if plan:
        states = {node.state for node in picture.nodes()}
    for state, look in STATES.items():
        if state not in states:
            continue
        yield (
            (
                f'<rect width="24" height="16" rx="3" class="s-{state.name.lower()}"/>'
                f'<text x="12" y="12" text-anchor="middle" class="t-{state.name.lower()}">'
                f"{look.symbol}</text>"
            ),
            state.value,
        )
    for presence in Presence:
        if (presence is Presence.PLANNED) is not plan:
            continue
        name = presence.value
        yield (
            f'<rect x="1" y="1" width="22" height="14" rx="3" class="box {name}"/>',
            PRESENCE_WORDS[presence],
        )
        yield f'<path d="M0 8H24" class="stroke {name}"/>', f"edge: {name}"
    ink = (Presence.PLANNED if plan else Presence.PRESENT).value
    thick = "a link demands a unique flow" if plan else "unique flow"
    yield f'<path d="M0 8H24" class="stroke {ink} unique"/>', f"thick edge: {thick}"
    yield f'<path d="M0 8H24" class="stroke {ink} service"/>', "thin edge: service or action"
    yield f'<circle cx="12" cy="8" r="5" class="mark {ink}"/>', "publisher or client"
    yield f'<path d="M18 8L8 2V14Z" class="mark {ink}"/>', "subscription or server"
    if plan:
        return
    warned = OUTCOMES[Outcome.VIOLATED]
    yield (
        f'<text x="12" y="12" text-anchor="middle" fill="{warned.fill}">⚠1</text>',
        "number of a finding",
    )


def _legend(entries: Iterable[tuple[str, str]], *, heading: str) -> tuple[int, list[str]]:
    x, y = 0, 24
    lines = [_text(0, 14, heading, "head")] if heading else []
    for drawing, words in entries:
        width = 32 + text_width(words, QUIET_EM) + 20
        if x + width > _LEGEND_WIDTH:
            x, y = 0, y + 24
        lines.append(f'<g transform="translate({x} {y})">{drawing}')
        lines.append(f"{_text(32, 12, words, 'quiet')}</g>")
        x += width
    return y + 30, lines


def _rect(x: int, y: int, width: int, height: int, attributes: str) -> str:
    return f'<rect x="{x}" y="{y}" width="{width}" height="{height}" rx="5" {attributes}/>'


def _text(x: int, y: int, words: str, class_: str, *, anchor: str = "") -> str:
    placed = f' text-anchor="{anchor}"' if anchor else ""
    return f'<text x="{x}" y="{y}" class="{class_}"{placed}>{_escape(words)}</text>'


def _attribute(words: str) -> str:
    return quoteattr(one_line(words))


def _escape(words: str) -> str:
    return escape(one_line(words))
