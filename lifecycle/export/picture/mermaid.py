"""A picture as a Mermaid flowchart, for Markdown. Owns Mermaid's syntax and escapes. Pure."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator

from lifecycle.export.picture.graph import Edge, edges, framed, node_words
from lifecycle.export.picture.model import DASHES, LINES, STATES, LineKind, Picture, PicturedNode


def picture_to_mermaid(picture: Picture) -> str:
    """Return one flowchart: nodes by machine and process, edges with their flows.

    States are colours and labels; missing is dashed and red, undeclared is dotted and orange; edges
    of unique flows are thick.
    """
    lines = ["---", f"title: {json.dumps(picture.title)}", "---", "flowchart LR"]
    lines += framed(picture, _opening, "end", _node)
    styles: list[str] = []
    for number, edge in enumerate(edges(picture)):
        lines.append(f"  {_edge(edge, f's{number}(( ))')}")
        if dash := DASHES[edge.presence]:
            styles.append(
                f"  linkStyle {number} stroke:{LINES[edge.presence]},stroke-dasharray:{dash}"
            )
    return "\n".join([*lines, *styles, *_classes(picture)]) + "\n"


def _opening(id_: str, title: str) -> str:
    return f"subgraph {id_}[{_quoted(title)}]"


def _node(node: PicturedNode) -> str:
    return f"{node.id}[{_quoted(*node_words(node))}]:::{_class(node)}"


def _edge(edge: Edge, stub: str) -> str:
    """An end without an opposite is drawn towards an empty circle."""
    arrow = "==>" if edge.unique else "-->" if edge.kind is LineKind.TOPIC else "-.->"
    return f"{edge.source or stub} {arrow}|{_quoted(*edge.words)}| {edge.target or stub}"


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


def _quoted(*words: str) -> str:
    """A quoted label of several lines; what Mermaid could read as syntax becomes an entity."""
    return '"' + "<br/>".join(map(_escape, words)) + '"'


def _escape(word: str) -> str:
    return re.sub(r"[^\w /.,:=()~+→-]", lambda match: f"#{ord(match[0])};", word)
