"""Layout of the computational graph and the data layer graph as rows and columns.

Owns: what is in which row and column: the computational graph has nodes and what they publish and
offer, the data layer graph participants and flows; and the arithmetic that places them: columns for
who, rows for what goes between them. Nothing ever overlaps, however much there is: many columns
have upright titles, a few horizontal ones. All text is monospaced, so that its width is known
without a font. Pure.
"""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Iterable, Sequence

from lifecycle import dataclasses
from lifecycle.export.picture.lines import OWN
from lifecycle.export.picture.model import (
    PRESENCE_WORDS,
    STATES,
    LineKind,
    Picture,
    PicturedEnd,
    PicturedFlow,
    PicturedLine,
    PicturedNode,
    PicturedParticipant,
    Presence,
    numbers,
    remark,
)
from lifecycle.verify import Outcome

MARGIN = 20
HEAD_EM, QUIET_EM = 12, 10
LINE = 14
_GAP = 12
_TITLE = 34
_MACHINE_HEAD, _PROCESS_HEAD = 24, 20
_WORDS_CHARACTERS = 68
_NOTE_CHARACTERS = 30
_LYING_AT_MOST = 1000
"""Columns lie as long as all of them are not wider than this, pixels."""
_LABEL_HEIGHT = 16


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """Who: a node or a participant.

    Attributes:
        id: unique in the matrix.
        title: in bold.
        badge: a state: its label; empty for none.
        notes: below, small.
        style: classes of its box, for CSS.
        badge_style: class of the badge.
    """

    id: str
    title: str
    badge: str
    notes: tuple[str, ...]
    style: str
    badge_style: str


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Group:
    """Columns in a frame within a frame; titles may be empty."""

    title: str
    inner: tuple[tuple[str, tuple[Column, ...]], ...]


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Mark:
    """One end on a row: a dot where something leaves, an arrowhead where it arrives."""

    column: str
    arrives: bool
    style: str
    words: str


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Stroke:
    """What goes from one column to another; `label` is written on it."""

    source: str
    target: str
    style: str
    words: str
    label: str = ""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One line of the picture.

    Attributes:
        notes: (text, class) small lines below its title.
    """

    id: str
    title: str
    notes: tuple[tuple[str, str], ...]
    style: str
    marks: tuple[Mark, ...]
    strokes: tuple[Stroke, ...]


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Frame:
    """A frame around columns."""

    title: str
    x: int
    y: int
    width: int
    height: int


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class PlacedColumn:
    """A column in its place: a box at the top, a line down from its centre."""

    column: Column
    notes: tuple[str, ...]
    x: int
    y: int
    width: int
    height: int

    @property
    def centre(self) -> int:
        """Horizontal middle."""
        return self.x + self.width // 2


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class PlacedRow:
    """A row in its place; `centre` is the height of its strokes."""

    row: Row
    notes: tuple[tuple[str, str], ...]
    y: int
    height: int
    centre: int


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Placed:
    """Everything in its place; lengths in pixels."""

    upright: bool
    width: int
    height: int
    machines: tuple[Frame, ...]
    processes: tuple[Frame, ...]
    columns: tuple[PlacedColumn, ...]
    rows: tuple[PlacedRow, ...]


def place(groups: Sequence[Group], rows: Sequence[Row]) -> Placed:
    """Place columns from left to right and rows from top to bottom."""
    columns = [column for group in groups for _, inner in group.inner for column in inner]
    notes = {each.id: wrapped(each.notes, _NOTE_CHARACTERS) for each in columns}
    lying = sum(_long_side(each, notes[each.id]) + _GAP for each in columns)
    upright = lying > _LYING_AT_MOST
    tall = max((_short_side(notes[each.id]) for each in columns), default=0)
    if upright:
        tall = max((_long_side(each, notes[each.id]) for each in columns), default=0)
    words = {row.id: _row_notes(row) for row in rows}
    left = max((_row_width(row, words[row.id]) for row in rows), default=0)
    top = _TITLE
    box_y = top + _MACHINE_HEAD + _PROCESS_HEAD
    rows_y = box_y + tall + 2 * _GAP

    placed_rows: list[PlacedRow] = []
    y = rows_y
    for row in rows:
        label = _LABEL_HEIGHT if any(stroke.label for stroke in row.strokes) else 6
        height = max(label + 24, 26 + (LINE - 1) * len(words[row.id]))
        placed_rows.append(
            PlacedRow(row=row, notes=words[row.id], y=y, height=height, centre=y + label + 8)
        )
        y += height

    machines: list[Frame] = []
    processes: list[Frame] = []
    placed: list[PlacedColumn] = []
    x = left + 2 * _GAP
    for group in groups:
        group_x = x
        x += _GAP
        for title, inner in group.inner:
            inner_x = x
            x += _GAP if title else 0
            for column in inner:
                own = notes[column.id]
                width = _short_side(own) if upright else _long_side(column, own)
                placed.append(
                    PlacedColumn(column=column, notes=own, x=x, y=box_y, width=width, height=tall)
                )
                x += width + (_GAP // 3 if upright else _GAP)
            if title:
                x = max(x, inner_x + text_width(title, QUIET_EM) + 2 * _GAP)
                processes.append(
                    Frame(
                        title=title,
                        x=inner_x,
                        y=top + _MACHINE_HEAD,
                        width=x - inner_x,
                        height=tall + _PROCESS_HEAD + _GAP // 2,
                    )
                )
                x += _GAP // 2
        x = max(x, group_x + text_width(group.title) + 2 * _GAP)
        machines.append(
            Frame(title=group.title, x=group_x, y=top, width=x - group_x, height=y - top)
        )
        x += _GAP
    return Placed(
        upright=upright,
        width=x,
        height=y,
        machines=tuple(machines),
        processes=tuple(processes),
        columns=tuple(placed),
        rows=tuple(placed_rows),
    )


def text_width(text: str, em: int = HEAD_EM) -> int:
    """Width of monospaced text, pixels."""
    return math.ceil(len(text) * em * 0.6)


class _Wrapper(textwrap.TextWrapper):
    """Breaks lines after what separates the options of a URL, too."""

    wordsep_simple_re = re.compile(r"(\s+|(?<=[?&]))")


def wrapped(texts: Iterable[str], width: int) -> tuple[str, ...]:
    """Break texts into lines of at most `width` characters."""
    wrapper = _Wrapper(width=width, break_on_hyphens=False)
    return tuple(line for each in texts for line in wrapper.wrap(each) or [""])


def _long_side(column: Column, notes: Sequence[str]) -> int:
    widths = [text_width(column.title), text_width(column.badge, QUIET_EM) + 12]
    return max(84, *widths, *(text_width(each, QUIET_EM) for each in notes)) + 16


def _short_side(notes: Sequence[str]) -> int:
    return 42 + (LINE - 1) * len(notes)


def _row_notes(row: Row) -> tuple[tuple[str, str], ...]:
    return tuple(
        (line, style) for text, style in row.notes for line in wrapped([text], _WORDS_CHARACTERS)
    )


def _row_width(row: Row, notes: Sequence[tuple[str, str]]) -> int:
    return max(text_width(row.title), *(text_width(text, QUIET_EM) for text, _ in notes), 0)


def computational(picture: Picture) -> tuple[tuple[Group, ...], tuple[Row, ...]]:
    """Return nodes as columns; topics, services and actions as rows."""
    groups = tuple(
        Group(
            title=machine.title,
            inner=tuple(
                (process.title, tuple(_node(node) for node in process.nodes))
                for process in machine.processes
            ),
        )
        for machine in picture.machines
    )
    names = {node.id: node.name for node in picture.nodes()}
    return groups, tuple(_line(line, names) for line in picture.lines)


def data_layer(picture: Picture) -> tuple[tuple[Group, ...], tuple[Row, ...]]:
    """Return participants as columns, those with flows or notes; flows as rows."""
    used = {end for flow in picture.flows for end in (flow.publisher, flow.subscription)}
    groups = []
    for machine in picture.machines:
        inner = []
        for process in machine.processes:
            pids = dict.fromkeys(node.pid for node in process.nodes if node.pid)
            pid = f", pid {', '.join(map(str, pids))}" if pids else ""
            title = (process.title or f"process {process.nodes[0].process}".rstrip()) + pid
            columns = tuple(
                _participant(node, each)
                for node in process.nodes
                for each in node.participants
                if each.id in used or each.name != OWN or each.notes or len(node.participants) == 1
            )
            inner.append((title if process.nodes[0].process else "", columns))
        groups.append(Group(title=machine.title, inner=tuple(inner)))
    return tuple(groups), tuple(_flow(flow) for flow in picture.flows)


def _node(node: PicturedNode) -> Column:
    warned = numbers(node.findings)
    return Column(
        id=node.id,
        title=node.name,
        badge=_badge(node),
        notes=(*node.notes, *((warned,) if warned else ())),
        style=f"node {node.presence.value}",
        badge_style=f"s-{node.state.name.lower()}",
    )


def _badge(node: PicturedNode) -> str:
    state = f"{STATES[node.state].symbol} {node.state.value}"
    if node.presence is Presence.MISSING:
        return f"{state}: missing"
    return f"{state} · pid {node.pid}" if node.pid else state


def _participant(node: PicturedNode, participant: PicturedParticipant) -> Column:
    return Column(
        id=participant.id,
        title=node.name,
        badge=participant.name,
        notes=(*remark(participant.presence), *participant.notes),
        style=f"participant {participant.presence.value}",
        badge_style="s-participant",
    )


def _line(line: PicturedLine, names: dict[str, str]) -> Row:
    notes = [(f"{line.kind.value} {' ≠ '.join(line.types)}", "quiet")]
    ends = [*((e, False) for e in line.sources), *((e, True) for e in line.targets)]
    for end, _ in ends:
        if not end.presence.as_declared or end.notes or end.findings:
            notes.append((_end_text(end, names), f"quiet {end.presence.value}"))
    if not (line.sources and line.targets):
        notes.append((_WITHOUT_PEER[line.kind, bool(line.targets)], "quiet alone"))
    return Row(
        id=line.id,
        title=line.name,
        notes=tuple(notes),
        style=f"line {line.kind.value} {line.presence.value}",
        marks=tuple(
            Mark(
                column=end.node,
                arrives=arrives,
                style=end.presence.value,
                words=f"{_end_text(end, names)} · {line.name}",
            )
            for end, arrives in ends
        ),
        strokes=tuple(
            Stroke(
                source=arrow.source,
                target=arrow.target,
                style=f"{arrow.presence.value} {line.kind.value} {_outcome(arrow.outcome)}",
                words=f"{names[arrow.source]} → {names[arrow.target]}: "
                f"{_outcome_text(arrow.presence, arrow.outcome)}",
            )
            for arrow in line.arrows
        ),
    )


_WITHOUT_PEER = {
    (LineKind.TOPIC, False): "nobody subscribes to it",
    (LineKind.TOPIC, True): "nobody publishes it",
    (LineKind.SERVICE, False): "nobody serves it",
    (LineKind.SERVICE, True): "nobody calls it",
    (LineKind.ACTION, False): "nobody serves it",
    (LineKind.ACTION, True): "nobody calls it",
}
"""Who is missing, by whether there is a target."""


def _end_text(end: PicturedEnd, names: dict[str, str]) -> str:
    words = end_words(end)
    return f"{names[end.node]}: {', '.join(words)}" if words else names[end.node]


def end_words(end: PicturedEnd) -> tuple[str, ...]:
    """Return the remark on an end beside its node's name."""
    return (*remark(end.presence), *end.notes, *filter(None, [numbers(end.findings)]))


def _outcome_text(presence: Presence, outcome: Outcome | None) -> str:
    return ", ".join([PRESENCE_WORDS[presence], *([outcome.value] if outcome else [])])


def _flow(flow: PicturedFlow) -> Row:
    return Row(
        id=flow.id,
        title=flow.topic,
        notes=tuple(_flow_notes(flow)),
        style=f"flow {flow.presence.value}",
        marks=(
            Mark(
                column=flow.publisher,
                arrives=False,
                style=flow.presence.value,
                words=f"{flow.names[0]} publishes {flow.topic}",
            ),
            Mark(
                column=flow.subscription,
                arrives=True,
                style=flow.presence.value,
                words=f"{flow.names[1]} subscribes to {flow.topic}",
            ),
        ),
        strokes=(
            Stroke(
                source=flow.publisher,
                target=flow.subscription,
                style=f"{flow.presence.value} {_outcome(flow.outcome)}"
                f"{' unique' if is_unique(flow) else ''}",
                words=f"{' → '.join(flow.names)}: {_outcome_text(flow.presence, flow.outcome)}",
                label=edge_label(flow),
            ),
        ),
    )


def edge_label(flow: PicturedFlow) -> str:
    """The label on the edge of a flow: medium, DSCP, uniqueness; or that it is not there.

    How unique a planned flow is to be is among its demands.
    """
    if flow.presence is Presence.MISSING:
        return "missing"
    dscp = flow.dscp.split(" = ", maxsplit=1)[0]
    known = flow.presence is not Presence.PLANNED and flow.unique != "uniqueness unknown"
    words = [flow.medium, dscp, flow.unique if known else ""]
    if flow.presence is Presence.UNDECLARED:
        words = ["not declared"]
    return " · ".join(filter(None, words))


def _flow_notes(flow: PicturedFlow) -> Iterable[tuple[str, str]]:
    yield " → ".join(flow.names), "quiet"
    for each in remark(flow.presence):
        yield each, f"quiet {flow.presence.value}"
    if flow.presence is Presence.PLANNED:
        if flow.dscp:
            yield flow.dscp, "quiet"
    elif flow.presence is not Presence.UNDECLARED:
        planned = f", planned {flow.planned}" if flow.planned not in ("", flow.medium) else ""
        yield (
            f"{flow.medium}{planned} · {flow.dscp or 'no DSCP read back'} · {flow.unique}",
            "quiet",
        )
    for each in flow.tuples:
        yield each, "quiet"
    if flow.demands:
        yield f"asked for: {', '.join(flow.demands)}", "quiet"
    if flow.outcome is not None and (flow.outcome is not Outcome.OK or flow.findings):
        said = f"{flow.outcome.value} {numbers(flow.findings)}".rstrip()
        yield said, f"quiet {_outcome(flow.outcome)}"


def _outcome(outcome: Outcome | None) -> str:
    return f"o-{outcome.value}" if outcome else "o-none"


def is_unique(flow: PicturedFlow) -> bool:
    """Return whether a flow is drawn thick."""
    return flow.unique in ("weakly unique", "strongly unique")
