"""Where everything of a picture stands: columns for who, rows for what goes between them.

Owns: the arithmetic. Nothing ever overlaps, however much there is: many columns stand upright
words, a few lie. All text is monospaced, so that its width is known without a font. Pure.
"""

from __future__ import annotations

import dataclasses
import math
import re
import textwrap
from collections.abc import Iterable, Sequence

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
        badge: a state: its words; empty for none.
        notes: below, small.
        style: classes of its box, words for CSS.
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
    """What goes from one column to another; `label` stands on it."""

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
    """Breaks words after what separates the options of a URL, too."""

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
