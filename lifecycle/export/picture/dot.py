"""A picture as a Graphviz graph. Owns DOT's syntax and escapes. Pure."""

from __future__ import annotations

from collections.abc import Iterator

from lifecycle.export.picture.graph import Edge, edges, framed, node_words
from lifecycle.export.picture.model import LINES, STATES, LineKind, Picture, PicturedNode, Presence
from lifecycle.printable import one_line

_STYLES = {
    Presence.PRESENT: "solid",
    Presence.MISSING: "dashed",
    Presence.UNDECLARED: "dotted",
    Presence.PLANNED: "solid",
}


def picture_to_dot(picture: Picture) -> str:
    """Return one digraph: nodes by machine and process, edges with their flows.

    States are colours and labels; missing is dashed and red, undeclared is dotted and orange; edges
    of unique flows are bold.
    """
    lines = [
        f"digraph {'planned' if picture.verdict is None else 'running'} {{",
        f"  label={_quoted(picture.title)};",
        "  rankdir=LR; labelloc=t; compound=true;",
        '  graph [fontname="sans-serif", style=rounded];',
        '  node [fontname="sans-serif", shape=box];',
        '  edge [fontname="sans-serif", fontsize=10];',
        *framed(picture, _opening, "}", _node),
    ]
    for number, edge in enumerate(edges(picture)):
        lines += [f"  {each}" for each in _edge(edge, f"stub{number}")]
    return "\n".join([*lines, "}"]) + "\n"


def _opening(id_: str, title: str) -> str:
    return f"subgraph cluster_{id_} {{ label={_quoted(title)};"


def _node(node: PicturedNode) -> str:
    look = STATES[node.state]
    return (
        f"{node.id} [label={_quoted(*node_words(node))}, "
        f'style="rounded,filled,{_STYLES[node.presence]}", fillcolor="{look.fill}", '
        f'fontcolor="{look.ink}", color="{LINES[node.presence]}", penwidth=2];'
    )


def _edge(edge: Edge, stub: str) -> Iterator[str]:
    """An end without an opposite is drawn towards an empty circle."""
    if not (edge.source and edge.target):
        yield f'{stub} [shape=circle, width=0.15, label=""];'
    head = "normal" if edge.kind is LineKind.TOPIC else "empty"
    yield (
        f"{edge.source or stub} -> {edge.target or stub} [label={_quoted(*edge.words)}, "
        f'arrowhead={head}, style={_STYLES[edge.presence]}, color="{LINES[edge.presence]}"'
        f"{', penwidth=3' if edge.unique else ''}];"
    )


def _quoted(*words: str) -> str:
    r"""A quoted label of several lines: `\n` ends one, and a backslash would escape something."""
    return '"' + r"\n".join(map(_escape, words)) + '"'


def _escape(word: str) -> str:
    return one_line(" ".join(word.replace("\\", "\\\\").replace('"', '\\"').split()))
