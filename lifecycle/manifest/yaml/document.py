"""YAML values with their source positions (file, line, column), paths into them, typed access.

Owns: `Value`, `Document` and the spelling of document paths. What reads a value as a scalar, a
sequence or a mapping relies on the schema (on a document that was not validated it may fail an
assertion). Knows nothing of YAML's syntax nor of what a manifest means, so that NoDL documents use
it as well. Pure.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from typing import Any

import msgspec

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


class Value(msgspec.Struct, frozen=True, kw_only=True):
    """One value of a document.

    Attributes:
        data: the scalar, or the items of a sequence, or the entries of a mapping.
        line: from 1.
        column: from 1.
        key: line and column of the key that names it in a mapping; None elsewhere.
        text: a scalar as written, without its quotes.
        quoted: the scalar was in quotes or was a block scalar: it is a string whatever it holds.
    """

    data: Scalar | tuple[Value, ...] | dict[str, Value]
    line: int
    column: int
    key: tuple[int, int] | None = None
    text: str = ""
    quoted: bool = False

    def inside(self, place: Place) -> Value | None:
        """Return the value at a place inside this one; None where there is none."""
        value: Value | None = self
        for step in place:
            data = None if value is None else value.data
            if isinstance(data, dict) and isinstance(step, str):
                value = data.get(step)
            elif isinstance(data, tuple) and isinstance(step, int):
                value = data[step] if 0 <= step < len(data) else None
            else:
                return None
        return value

    def plain(self, *, null: Any = None) -> Any:
        """Return the value without positions, as `Plain`; `null` is put for each null."""
        if isinstance(self.data, tuple):
            return [each.plain(null=null) for each in self.data]
        if isinstance(self.data, dict):
            return {key: each.plain(null=null) for key, each in self.data.items()}
        return null if self.data is None else self.data


class Document(msgspec.Struct, frozen=True, kw_only=True):
    """A value of one file, and where it is: a whole file, or any part of it.

    Attributes:
        file: path as the user wrote it.
        root: the outermost value; a mapping when read by `source.read_document`.
        place: path of `root` in that file; empty for a whole file.
    """

    file: str
    root: Value
    place: Place = ()

    @property
    def scalar(self) -> Scalar:
        """The value of a scalar."""
        assert not isinstance(self.root.data, (tuple, dict))
        return self.root.data

    def find(self, place: Place) -> Value | None:
        """Return the value at a place relative to `root`; None where there is none."""
        return self.root.inside(place)

    def plain(self, place: Place = ()) -> Any:
        """Return the value at a place without positions; an empty mapping where there is none."""
        value = self.find(place)
        return {} if value is None else value.plain()

    def at(self, place: Place = ()) -> Position:
        """Return the position of the value at `place`, or of the nearest value around it."""
        value = self._nearest(place)
        return self._position(value.line, value.column, place)

    def key_at(self, place: Place = ()) -> Position:
        """Return the position of the key at `place`; of the value for items of a sequence."""
        value = self._nearest(place)
        return self._position(*(value.key or (value.line, value.column)), place)

    def _nearest(self, place: Place) -> Value:
        lengths = range(len(place), -1, -1)
        return next(value for length in lengths if (value := self.find(place[:length])) is not None)

    def _position(self, line: int, column: int, place: Place) -> Position:
        spelled = spell_place((*self.place, *place))
        return Position(file=self.file, line=line, column=column, path=spelled)

    def __contains__(self, key: str) -> bool:
        return isinstance(self.root.data, dict) and key in self.root.data

    def get(self, *place: str | int) -> Document | None:
        """Return the part at a place; None where there is none."""
        value = self.find(place)
        return None if value is None else self._part(value, *place)

    def _part(self, value: Value, *place: str | int) -> Document:
        return Document(file=self.file, root=value, place=(*self.place, *place))

    def entries(self, *keys: str) -> Iterator[tuple[str, Document]]:
        """Return the entries of a mapping below this one, in order; none where it is missing."""
        value = self.find(keys)
        data = {} if value is None else value.data
        assert isinstance(data, dict)
        return ((key, self._part(each, *keys, key)) for key, each in data.items())

    def items(self, *keys: str) -> Iterator[Document]:
        """Return the items of a sequence below this mapping; none where it is missing."""
        value = self.find(keys)
        data = () if value is None else value.data
        assert isinstance(data, tuple)
        return (self._part(each, *keys, index) for index, each in enumerate(data))

    def children(self) -> Iterator[tuple[str, Document]]:
        """Return what is directly inside, by key or index; nothing inside a scalar."""
        if isinstance(self.root.data, tuple):
            yield from ((str(index), each) for index, each in enumerate(self.items()))
        elif isinstance(self.root.data, dict):
            yield from self.entries()

    def text(self, key: str, default: str = "") -> str:
        """Return a string; any other scalar as it was written."""
        value = self.find((key,))
        return default if value is None else value.text


def error(rule: str, at: Position, message: str, hint: str = "") -> Diagnostic:
    """Make an error; `message` starts with "cannot"."""
    return Diagnostic(rule=rule, severity=Severity.ERROR, at=at, message=message, hint=hint)


def warning(rule: str, at: Position, message: str, hint: str = "") -> Diagnostic:
    """Make a warning: something that is declared is in doubt; `message` starts with "cannot"."""
    return Diagnostic(rule=rule, severity=Severity.WARNING, at=at, message=message, hint=hint)


def note(rule: str, at: Position, message: str, hint: str = "") -> Diagnostic:
    """Make a note: advice, with nothing in doubt that is declared; `message` as of a warning."""
    return Diagnostic(rule=rule, severity=Severity.NOTE, at=at, message=message, hint=hint)
