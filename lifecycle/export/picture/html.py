"""A picture as one self-contained HTML page: no network, no other file.

Owns: the page, its contents and their order, and that nothing of a graph is ever taken for markup;
the style sheet, and the script, which only filters rows and highlights what belongs together on
hovering. Without the script everything is there. Pure.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from html import escape

from lifecycle.export.picture.model import (
    OUTCOMES,
    PRESENCE_WORDS,
    STATES,
    Picture,
    PicturedFinding,
    PicturedFlow,
    PicturedNode,
    Presence,
    remark,
)
from lifecycle.export.picture.svg import HEADINGS, figure_svg, legend_svg, style
from lifecycle.export.picture.views import computational, data_layer, place
from lifecycle.printable import one_line
from lifecycle.verify import Outcome

CSS = """\
:root{color-scheme:light}
body{margin:0;font:15px/1.45 system-ui,-apple-system,"Segoe UI",sans-serif;color:#1b2733;
background:#fff}
header,main{padding:0 1.5rem}
header{border-bottom:1px solid #c9d3df;background:#f6f8fb;padding-top:1rem;padding-bottom:.75rem}
h1{margin:0;font-size:1.5rem}
h2{margin:1.6rem 0 .3rem;font-size:1.15rem}
header p{margin:.2rem 0}
.hint{margin:.1rem 0 .6rem;color:#4d5a66}
.verdict{display:inline-block;padding:.25rem .6rem;border-radius:.4rem;border:1px solid}
.verdict.o-ok{background:#e3f4ee;border-color:#009e73}
.verdict.o-violated{background:#fbe9e7;border-color:#b3261e}
.verdict.o-unverifiable{background:#fdf3dc;border-color:#8a5a00}
td .o-ok,th .o-ok{color:#00664a;font-weight:600}
td .o-violated{color:#b3261e;font-weight:600}
td .o-unverifiable{color:#8a5a00;font-weight:600}
dl{display:flex;flex-wrap:wrap;gap:.4rem 1.6rem;margin:.6rem 0 .2rem}
dl div{display:flex;gap:.4rem}
dt{color:#4d5a66}dd{margin:0;font-weight:600}
.figure,.table{overflow:auto;border:1px solid #dde4ec;border-radius:.4rem;background:#fff}
.figure{max-height:85vh}
.figure svg{display:block}
.figure:focus-visible,.table:focus-visible,a:focus-visible,input:focus-visible{
outline:3px solid #0072b2;outline-offset:2px}
table{border-collapse:collapse;width:100%;font-size:.9rem}
th,td{padding:.35rem .6rem;text-align:left;vertical-align:top;border-bottom:1px solid #e6ebf1}
thead th{background:#f1f5fb;position:sticky;top:0}
tbody th{font-weight:600}
tbody tr:hover{background:#fff8df}
code{font:.92em ui-monospace,Menlo,Consolas,"DejaVu Sans Mono",monospace}
.state{display:inline-block;padding:.05rem .45rem;border-radius:.3rem;border:1px solid #8ea3bb;
white-space:nowrap}
.p-missing{color:#b3261e;font-weight:600;border-bottom:2px dashed #b3261e}
.p-undeclared{color:#a84b00;font-weight:600;border-bottom:2px dotted #c75b00}
a{color:#00598c}
.skip{position:absolute;left:-999px}
.skip:focus{left:1rem;top:.5rem;background:#fff;padding:.3rem .6rem}
input{font:inherit;padding:.2rem .4rem}
tr.gone{display:none}
@media print{.figure{max-height:none;overflow:visible}.filter{display:none}}
"""

SCRIPT = """\
"use strict";
(function () {
  var figures = document.querySelectorAll("svg.lc-figure");
  figures.forEach(function (figure) {
    var rows = figure.querySelectorAll("g.row");
    var columns = figure.querySelectorAll("g.column");
    function clear() {
      rows.forEach(function (row) { row.classList.remove("lit", "dim"); });
      columns.forEach(function (column) { column.classList.remove("dim"); });
    }
    columns.forEach(function (column) {
      column.addEventListener("mouseenter", function () {
        rows.forEach(function (row) {
          var mine = row.dataset.columns.split(" ").includes(column.dataset.column);
          row.classList.toggle("lit", mine);
          row.classList.toggle("dim", !mine);
        });
      });
      column.addEventListener("mouseleave", clear);
    });
    rows.forEach(function (row) {
      row.addEventListener("mouseenter", function () {
        var ends = row.dataset.columns.split(" ");
        columns.forEach(function (column) {
          column.classList.toggle("dim", !ends.includes(column.dataset.column));
        });
      });
      row.addEventListener("mouseleave", clear);
    });
  });
  var box = document.querySelector(".filter");
  var filter = document.getElementById("filter");
  box.hidden = false;
  filter.addEventListener("input", function () {
    var wanted = filter.value.trim().toLowerCase();
    document.querySelectorAll("tbody tr").forEach(function (row) {
      row.classList.toggle("gone", !row.textContent.toLowerCase().includes(wanted));
    });
    document.querySelectorAll("svg.lc-figure g.row").forEach(function (row) {
      row.classList.toggle("faint", !row.textContent.toLowerCase().includes(wanted));
    });
  });
})();
"""


_VERDICTS = {
    Outcome.OK: "What runs is what was declared.",
    Outcome.VIOLATED: "What runs is not what was declared.",
    Outcome.UNVERIFIABLE: "Not everything could be verified.",
}


def picture_to_html(picture: Picture) -> str:
    """Return the whole page."""
    return "\n".join(_page(picture)) + "\n"


def _page(picture: Picture) -> Iterator[str]:
    yield "<!DOCTYPE html>"
    yield '<html lang="en">'
    yield "<head>"
    yield '<meta charset="utf-8">'
    yield '<meta name="viewport" content="width=device-width, initial-scale=1">'
    yield (
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; '
        "style-src 'unsafe-inline'; script-src 'unsafe-inline'\">"
    )
    yield f"<title>{_text(picture.title)}</title>"
    yield f"<style>\n{CSS}\n{style()}\n</style>"
    yield "</head>"
    yield "<body>"
    planned = picture.verdict is None
    first = "nodes" if planned else "findings"
    yield f'<a class="skip" href="#{first}">Skip to the {first}</a>'
    yield from _header(picture)
    yield "<main>"
    views = (computational(picture), data_layer(picture))
    for name, heading, view in zip(("nodes", "flows"), HEADINGS, views, strict=True):
        yield f'<section aria-labelledby="figure-{name}">'
        yield f'<h2 id="figure-{name}">{heading}</h2>'
        yield f'<p class="hint">{_HINTS[name]}</p>'
        yield f'<div class="figure" tabindex="0" role="group" aria-label="{heading}, scrollable">'
        yield figure_svg(heading, place(*view))
        yield "</div>"
        yield "</section>"
    yield '<section aria-labelledby="legend-head"><h2 id="legend-head">Legend</h2>'
    yield '<div class="figure" tabindex="0" role="group" aria-label="Legend">'
    yield f"{legend_svg(picture)}</div>"
    yield "</section>"
    if not planned:
        yield from _findings(picture.findings)
    yield from _nodes(picture)
    yield from _flows(picture)
    yield "</main>"
    yield f"<script>\n{SCRIPT}\n</script>"
    yield "</body>"
    yield "</html>"


_HINTS = {
    "nodes": "Each column is a node, each row a topic, service or action, from who publishes or "
    "asks (●) to who subscribes or answers (▶).",
    "flows": "Each column is a DDS participant, each row a flow with what carries it, its DSCP and "
    "how unique it is.",
}


def _header(picture: Picture) -> Iterator[str]:
    yield "<header>"
    yield f"<h1>{_text(picture.system)}</h1>"
    phase = f", {_text(picture.phase)}" if picture.phase else ""
    yield f"<p>ROS domain {picture.domain_id}{phase}</p>"
    if picture.verdict is None:
        yield "<p>What is declared; whether it runs was not looked at.</p>"
    else:
        yield (
            f'<p class="verdict o-{picture.verdict.value}"><strong>'
            f"{OUTCOMES[picture.verdict].symbol} verdict {picture.verdict.value}</strong> "
            f"{_VERDICTS[picture.verdict]}</p>"
        )
    yield "<dl>"
    for word, count in _counts(picture):
        yield f"<div><dt>{word}</dt><dd>{count}</dd></div>"
    yield "</dl>"
    yield (
        '<p class="filter" hidden><label for="filter">Show only rows that name </label>'
        '<input id="filter" type="search" autocomplete="off"></p>'
    )
    yield "</header>"


def _counts(picture: Picture) -> Iterator[tuple[str, int]]:
    nodes = picture.nodes()
    yield "nodes", len(nodes)
    if picture.verdict is None:
        yield "flows", len(picture.flows)
        return
    for presence in (Presence.MISSING, Presence.UNDECLARED):
        yield f"{presence.value} nodes", sum(node.presence is presence for node in nodes)
    yield "flows", len(picture.flows)
    yield "findings", len(picture.findings)


def _findings(findings: Sequence[PicturedFinding]) -> Iterator[str]:
    yield '<section id="findings" aria-labelledby="findings-head">'
    yield '<h2 id="findings-head">Findings</h2>'
    if not findings:
        yield "<p>None.</p>"
    else:
        rows = [
            (
                f'<span id="finding-{each.number}">⚠{each.number}</span>',
                (
                    f'<span class="o-{each.outcome.value}">{OUTCOMES[each.outcome].symbol} '
                    f"{each.outcome.value}</span>"
                ),
                f"<code>{_text(each.rule)}</code>",
                _text(each.message) + (f"<br><em>{_text(each.hint)}</em>" if each.hint else ""),
                f"<code>{_text(each.at)}</code>" if each.at else "–",
            )
            for each in findings
        ]
        yield from _table(("no.", "outcome", "rule", "what", "where"), rows)
    yield "</section>"


def _nodes(picture: Picture) -> Iterator[str]:
    yield '<section id="nodes" aria-labelledby="nodes-head"><h2 id="nodes-head">Nodes</h2>'
    rows = [_node(node) for node in picture.nodes()]
    heads = ("node", "state", "declared?", "machine", "process", "pid", "participants", "findings")
    yield from _table(heads, rows, without=_RUNNING if picture.verdict is None else ())
    yield "</section>"


def _node(node: PicturedNode) -> tuple[str, ...]:
    look = STATES[node.state]
    participants = "<br>".join(
        _text(", ".join([each.name, *remark(each.presence), *each.notes]))
        for each in node.participants
    )
    notes = f"<br><small>{_text(', '.join(node.notes))}</small>" if node.notes else ""
    return (
        f"<code>{_text(node.name)}</code>{notes}",
        (
            f'<span class="state" style="background:{look.fill};color:{look.ink}">{look.symbol} '
            f"{node.state.value}</span>"
        ),
        _presence(node.presence),
        _text(node.machine) or "–",
        _text(node.process) or "–",
        str(node.pid or "–"),
        participants,
        _links(node.findings),
    )


_RUNNING = ("declared?", "pid", "findings", "network flow endpoints", "verdict")
"""Columns about what runs, which the picture of a plan leaves out."""


def _flows(picture: Picture) -> Iterator[str]:
    yield '<section aria-labelledby="flows-head"><h2 id="flows-head">Flows</h2>'
    heads = (
        "topic",
        "publisher → subscription",
        "declared?",
        "medium",
        "network flow endpoints",
        "DSCP",
        "unique",
        "asked for",
        "verdict",
    )
    rows = [
        (
            f"<code>{_text(each.topic)}</code>",
            f"<code>{_text(' → '.join(each.names))}</code>",
            _presence(each.presence),
            _medium(each),
            "<br>".join(f"<code>{_text(one)}</code>" for one in each.tuples) or "unknown",
            _text(each.dscp) or "–",
            _text(each.unique) or "–",
            _text(", ".join(each.demands)) or "–",
            _outcome(each),
        )
        for each in picture.flows
    ]
    if rows:
        yield from _table(heads, rows, without=_RUNNING if picture.verdict is None else ())
    else:
        yield "<p>None.</p>"
    yield "</section>"


def _medium(flow: PicturedFlow) -> str:
    planned = "" if flow.planned in ("", flow.medium) else f"<br>planned {_text(flow.planned)}"
    return (_text(flow.medium) or "–") + planned


def _outcome(flow: PicturedFlow) -> str:
    if flow.outcome is None or flow.presence is Presence.UNDECLARED:
        return "–"
    word, symbol = flow.outcome.value, OUTCOMES[flow.outcome].symbol
    return f'<span class="o-{word}">{symbol} {word}</span> {_links(flow.findings)}'


def _table(
    heads: Sequence[str], rows: Iterable[Sequence[str]], *, without: Sequence[str] = ()
) -> Iterator[str]:
    """A table whose first column names its rows; cells are HTML already.

    Args:
        heads: of the columns.
        rows: a cell for each of `heads`.
        without: heads of the columns that are left out.
    """
    yield '<div class="table" tabindex="0" role="group" aria-label="table, scrollable"><table>'
    cells = "".join(f'<th scope="col">{head}</th>' for head in heads if head not in without)
    yield f"<thead><tr>{cells}</tr></thead><tbody>"
    for row in rows:
        first, *others = (
            cell for head, cell in zip(heads, row, strict=True) if head not in without
        )
        cells = "".join(f"<td>{cell}</td>" for cell in others)
        yield f'<tr><th scope="row">{first}</th>{cells}</tr>'
    yield "</tbody></table></div>"


def _presence(presence: Presence) -> str:
    return f'<span class="p-{presence.value}">{PRESENCE_WORDS[presence]}</span>'


def _links(findings: Iterable[int]) -> str:
    return " ".join(f'<a href="#finding-{each}">⚠{each}</a>' for each in findings) or "–"


def _text(words: str) -> str:
    return escape(one_line(words))
