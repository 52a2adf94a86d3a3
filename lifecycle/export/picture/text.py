"""A picture as plain text. Owns its lines. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from lifecycle.export.picture.model import (
    OUTCOMES,
    STATES,
    Picture,
    PicturedArrow,
    PicturedFlow,
    PicturedLine,
    PicturedNode,
    Presence,
    numbers,
    remark,
)
from lifecycle.export.picture.views import edge_label, end_words
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
