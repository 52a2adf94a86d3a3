"""YAML values with their source positions (file, line, column), and paths into a document.

Owns: `Value`, `Document` and the spelling of document paths. Knows nothing of YAML's syntax nor
of what a manifest means, so that NoDL documents use it as well. Pure.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Mapping, Sequence

from lifecycle.manifest.diagnostics import Diagnostic, Position, Severity

Scalar = bool | int | float | str | None
"""A scalar of YAML 1.2's core schema."""

Plain = Scalar | list["Plain"] | dict[str, "Plain"]
"""A value without positions, as a JSON Schema validator wants it."""

Place = tuple[str | int, ...]
"""Keys and indices from the root of a document to a value."""

_BARE_KEY = re.compile(r"[A-Za-z_][A-Za-z0-9_-]*\Z")


def spell_place(place: Sequence[str | int]) -> str:
    """Spell a place as people read it: `nodes.camera.publishers[0]`, `flows["/robot/video"]`."""
    spelled = ""
    for step in place:
        if isinstance(step, int):
            spelled += f"[{step}]"
        elif _BARE_KEY.match(step):
            spelled += f".{step}" if spelled else step
        else:
            spelled += f"[{json.dumps(step, ensure_ascii=False)}]"
    return spelled


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Value:
    """One value of a document.

    Attributes:
        data: the scalar, or the items of a sequence, or the entries of a mapping.
        line: from 1.
        column: from 1.
        key: line and column of the key that names it in a mapping; None elsewhere.
        text: a scalar as written, without its quotes.
        quoted: the scalar was in quotes or was a block scalar: it is a string whatever it holds.
    """

    data: Scalar | tuple[Value, ...] | Mapping[str, Value]
    line: int
    column: int
    key: tuple[int, int] | None = None
    text: str = ""
    quoted: bool = False

    def plain(self) -> Plain:
        """Return the value without positions."""
        if isinstance(self.data, tuple):
            return [each.plain() for each in self.data]
        if isinstance(self.data, Mapping):
            return {key: each.plain() for key, each in self.data.items()}
        return self.data


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Document:
    """One file's content.

    Attributes:
        file: path as the user wrote it.
        root: the outermost value; a mapping when read by `source.read_document`.
        place: path of `root` in that file; empty for a whole file.
    """

    file: str
    root: Value
    place: Place = ()

    def find(self, place: Place) -> Value | None:
        """Return the value at a place relative to `root`; None where there is none."""
        value = self.root
        for step in place:
            child: Value | None = None
            if isinstance(value.data, Mapping) and isinstance(step, str):
                child = value.data.get(step)
            elif isinstance(value.data, tuple) and isinstance(step, int):
                child = value.data[step] if 0 <= step < len(value.data) else None
            if child is None:
                return None
            value = child
        return value

    def at(self, place: Place = ()) -> Position:
        """Return the position of the value at `place`, or of the nearest value around it."""
        value = self._nearest(place)
        return self._position(value.line, value.column, place)

    def key_at(self, place: Place) -> Position:
        """Return the position of the key at `place`; of the value for items of a sequence."""
        value = self._nearest(place)
        line, column = value.key or (value.line, value.column)
        return self._position(line, column, place)

    def _nearest(self, place: Place) -> Value:
        for length in range(len(place), 0, -1):
            value = self.find(place[:length])
            if value is not None:
                return value
        return self.root

    def _position(self, line: int, column: int, place: Place) -> Position:
        spelled = spell_place((*self.place, *place))
        return Position(file=self.file, line=line, column=column, path=spelled)


def error(rule: str, at: Position, message: str, hint: str = "") -> Diagnostic:
    """Make an error; `message` starts with "cannot"."""
    return Diagnostic(rule=rule, severity=Severity.ERROR, at=at, message=message, hint=hint)


def warning(rule: str, at: Position, message: str, hint: str = "") -> Diagnostic:
    """Make a warning; `message` starts with "cannot"."""
    return Diagnostic(rule=rule, severity=Severity.WARNING, at=at, message=message, hint=hint)
