"""A picture as one self-contained HTML page: verdict, drawing, findings, a filter. Pure.

It needs no network and no other file, and nothing of a graph is ever taken for markup. Its script
only hides what does not have the words of the filter; without it everything is there.
"""

from __future__ import annotations

from collections.abc import Iterator

from lifecycle.export.picture.drawing import escaped, picture_to_svg
from lifecycle.export.picture.model import Picture
from lifecycle.export.picture.text import OUTCOMES

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
