"""YAML values with their source positions (file, line, column), paths into them, typed access.

Owns: `Value`, `Document` and the spelling of document paths; `Cursor`, which reads a value with the
type that the schema has already ensured (on a document that was not validated it may fail an
assertion). Knows nothing of YAML's syntax nor of what a manifest means, so that NoDL documents use
it as well. Pure.
"""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, TypeVar, get_type_hints

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
        return self.root.inside(place)

    def plain(self, place: Place) -> Any:
        """Return the value at a place without positions; an empty mapping where there is none."""
        value = self.find(place)
        return {} if value is None else value.plain()

    def at(self, place: Place = ()) -> Position:
        """Return the position of the value at `place`, or of the nearest value around it."""
        return self.position(self._nearest(place), place)

    def key_at(self, place: Place) -> Position:
        """Return the position of the key at `place`; of the value for items of a sequence."""
        return self.key_position(self._nearest(place), place)

    def _nearest(self, place: Place) -> Value:
        for length in range(len(place), 0, -1):
            value = self.find(place[:length])
            if value is not None:
                return value
        return self.root

    def position(self, value: Value, place: Place) -> Position:
        """Return the position of a value that is at `place`."""
        spelled = spell_place((*self.place, *place))
        return Position(file=self.file, line=value.line, column=value.column, path=spelled)

    def key_position(self, value: Value, place: Place) -> Position:
        """Return the position of the key of a value that is at `place`."""
        line, column = value.key or (value.line, value.column)
        spelled = spell_place((*self.place, *place))
        return Position(file=self.file, line=line, column=column, path=spelled)


def error(rule: str, at: Position, message: str, hint: str = "") -> Diagnostic:
    """Make an error; `message` starts with "cannot"."""
    return Diagnostic(rule=rule, severity=Severity.ERROR, at=at, message=message, hint=hint)


def warning(rule: str, at: Position, message: str, hint: str = "") -> Diagnostic:
    """Make a warning: something that is declared is in doubt; `message` starts with "cannot"."""
    return Diagnostic(rule=rule, severity=Severity.WARNING, at=at, message=message, hint=hint)


def note(rule: str, at: Position, message: str, hint: str = "") -> Diagnostic:
    """Make a note: advice, with nothing in doubt that is declared; `message` as of a warning."""
    return Diagnostic(rule=rule, severity=Severity.NOTE, at=at, message=message, hint=hint)


T = TypeVar("T")

_EXACT = 2**53
"""Above, a float cannot represent every integer."""


class Cursor(msgspec.Struct, frozen=True, kw_only=True):
    """A place in a document, and the value there."""

    document: Document
    place: Place
    value: Value

    @classmethod
    def root(cls, document: Document) -> Cursor:
        """Return the cursor on a whole document."""
        return cls(document=document, place=(), value=document.root)

    @property
    def at(self) -> Position:
        """Position of the value."""
        return self.document.position(self.value, self.place)

    @property
    def key_at(self) -> Position:
        """Position of the key of the value."""
        return self.document.key_position(self.value, self.place)

    @property
    def scalar(self) -> Scalar:
        """The value of a scalar."""
        assert not isinstance(self.value.data, (tuple, dict))
        return self.value.data

    def __contains__(self, key: str) -> bool:
        return isinstance(self.value.data, dict) and key in self.value.data

    def get(self, *keys: str) -> Cursor | None:
        """Return the cursor on a value below this mapping; None where a key is missing."""
        value = self.value.inside(keys)
        return None if value is None else self.below(value, *keys)

    def below(self, value: Value, *steps: str | int) -> Cursor:
        """Return the cursor on a value that is some steps inside this one."""
        return Cursor(document=self.document, place=(*self.place, *steps), value=value)

    def entries(self, *keys: str) -> Iterator[tuple[str, Cursor]]:
        """Return the entries of a mapping below this one, in order; none where it is missing."""
        cursor = self.get(*keys)
        if cursor is None:
            return
        assert isinstance(cursor.value.data, dict)
        for key, value in cursor.value.data.items():
            yield key, cursor.below(value, key)

    def items(self, *keys: str) -> Iterator[Cursor]:
        """Return the items of a sequence below this mapping; none where it is missing."""
        cursor = self.get(*keys)
        if cursor is None:
            return
        assert isinstance(cursor.value.data, tuple)
        for index, value in enumerate(cursor.value.data):
            yield cursor.below(value, index)

    def children(self) -> Iterator[tuple[str, Cursor]]:
        """Return what is directly inside, by key or index; nothing inside a scalar."""
        if isinstance(self.value.data, tuple):
            yield from ((str(index), each) for index, each in enumerate(self.items()))
        elif isinstance(self.value.data, dict):
            yield from self.entries()

    def text(self, key: str, default: str = "") -> str:
        """Return a string; any other scalar as it was written."""
        cursor = self.get(key)
        return default if cursor is None else cursor.value.text

    def build(self, type_: type[T], /, **computed: Any) -> T:
        """Return a Struct whose fields are keys of this mapping.

        Args:
            type_: its fields have the keys' names; what is not written keeps its default. A text is
                what was written, whatever scalar it is read as.
            computed: fields that are more than the value of their key.
        """
        known: type = type_
        for name, hint in _hints(known).items():
            value = None if name in computed else self.value.inside((name,))
            if value is not None:
                computed[name] = _converted(value, hint)
        return type_(**computed)


@functools.lru_cache(maxsize=32)
def _hints(type_: type) -> Mapping[str, Any]:
    return get_type_hints(type_)


def _converted(value: Value, hint: Any) -> Any:
    if hint is str:
        return value.text
    if isinstance(value.data, tuple):
        return tuple(each.text for each in value.data)
    number = value.data
    if isinstance(number, Mapping):
        return msgspec.convert(value.plain(), hint, strict=False)
    if isinstance(number, float) and number.is_integer() and abs(number) < _EXACT:
        number = int(number)  # JSON Schema counts 5.0 as an integer
    return msgspec.convert(number, hint)
