"""Typed access by key to a validated document, with source positions.

Owns: `Cursor`, which reads a value with the type that the schema has already ensured, and knows its
position. A cursor on a document that was not validated may fail an assertion. Pure.
"""

from __future__ import annotations

import dataclasses
import enum
import functools
from collections.abc import Iterator, Mapping
from typing import Any, TypeVar, get_type_hints

import msgspec

from lifecycle.manifest.diagnostics import Position
from lifecycle.manifest.yaml.document import Document, Place, Scalar, Value

E = TypeVar("E", bound=enum.Enum)
T = TypeVar("T")

_EXACT = 2**53
"""Above, a float cannot represent every integer."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Cursor:
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
        return self.document.at(self.place)

    @property
    def key_at(self) -> Position:
        """Position of the key of the value."""
        return self.document.key_at(self.place)

    @property
    def scalar(self) -> Scalar:
        """The value of a scalar."""
        assert not isinstance(self.value.data, (tuple, Mapping))
        return self.value.data

    def __contains__(self, key: str) -> bool:
        return isinstance(self.value.data, Mapping) and key in self.value.data

    def get(self, *keys: str) -> Cursor | None:
        """Return the cursor on a value below this mapping; None where a key is missing."""
        place: Place = (*self.place, *keys)
        value = self.document.find(place)
        return None if value is None else Cursor(document=self.document, place=place, value=value)

    def entries(self, *keys: str) -> Iterator[tuple[str, Cursor]]:
        """Return the entries of a mapping below this one, in order; none where it is missing."""
        cursor = self.get(*keys)
        if cursor is None:
            return
        assert isinstance(cursor.value.data, Mapping)
        for key, value in cursor.value.data.items():
            yield key, Cursor(document=self.document, place=(*cursor.place, key), value=value)

    def items(self, *keys: str) -> Iterator[Cursor]:
        """Return the items of a sequence below this mapping; none where it is missing."""
        cursor = self.get(*keys)
        if cursor is None:
            return
        assert isinstance(cursor.value.data, tuple)
        for index, value in enumerate(cursor.value.data):
            yield Cursor(document=self.document, place=(*cursor.place, index), value=value)

    def text(self, key: str, default: str = "") -> str:
        """Return a string; any other scalar as it was written."""
        cursor = self.get(key)
        return default if cursor is None else cursor.value.text

    def integer(self, key: str) -> int | None:
        """Return an integer; None where the key is missing. JSON Schema counts 5.0 as one."""
        cursor = self.get(key)
        if cursor is None:
            return None
        assert isinstance(cursor.scalar, (int, float))
        return int(cursor.scalar)

    def choice(self, key: str, type_: type[E], default: E) -> E:
        """Return an enum by its value."""
        cursor = self.get(key)
        return default if cursor is None else type_(cursor.scalar)

    def build(self, type_: type[T], /, **computed: Any) -> T:
        """Return a dataclass whose fields are keys of this mapping.

        Args:
            type_: its fields have the keys' names; what is not written keeps its default. A text is
                what was written, whatever scalar it is read as.
            computed: fields that are more than the value of their key.
        """
        known: type = type_
        for name, hint in _hints(known).items():
            value = None if name in computed else self.document.find((*self.place, name))
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
    if isinstance(number, float) and number.is_integer() and abs(number) < _EXACT:
        number = int(number)  # JSON Schema counts 5.0 as an integer
    return msgspec.convert(number, hint)
