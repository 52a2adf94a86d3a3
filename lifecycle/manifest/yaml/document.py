"""YAML values with their source positions, paths into them, typed access; what scalars mean.

Owns: `Value`, `Document`, the spelling of document paths, and the one place where text becomes
bool, int, float, null or string. What reads a value as a scalar, a sequence or a mapping relies on
the schema. Knows nothing of what a manifest means. Pure.

Unquoted scalars follow YAML 1.2.2 §10.3.2, the core schema. So `yes`, `on`, `off` and `1:30` are
strings here, and `0o17` is octal. In one thing the rules are narrower, as JSON is: an integer does
not begin with 0, which versions of YAML read differently.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Sequence
from typing import Any

import msgspec

from lifecycle.manifest.diagnostics import Position

Scalar = bool | int | float | str | None
"""A scalar of YAML 1.2's core schema."""


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
    """One value of a document; lines and columns count from 1.

    Attributes:
        data: the scalar, or the items of a sequence, or the entries of a mapping.
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

    def plain(self, *, null: Any = None) -> Any:
        """Return lists, mappings and scalars without positions; `null` is put for each null."""
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
        value: Value | None = self.root
        for step in place:
            data = None if value is None else value.data
            if isinstance(data, dict) and isinstance(step, str):
                value = data.get(step)
            elif isinstance(data, tuple) and isinstance(step, int):
                value = data[step] if 0 <= step < len(data) else None
            else:
                return None
        return value

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


INT64_MIN = -(2**63)
INT64_MAX = 2**63 - 1
"""ROS integers are int64 (rcl_interfaces/ParameterValue)."""

YAML_1_1_BOOLEANS = frozenset(
    spelled
    for word in ("y", "yes", "on", "n", "no", "off")
    for spelled in (word, word.capitalize(), word.upper())
)
"""Booleans of YAML 1.1 (and of rcl's parameter files) that YAML 1.2 reads as strings."""

_NULL = frozenset({"", "~", "null", "Null", "NULL"})
_TRUE = frozenset({"true", "True", "TRUE"})
_FALSE = frozenset({"false", "False", "FALSE"})
_DECIMAL = re.compile(r"[-+]?(0|[1-9][0-9]*)\Z")
_LEADING_ZERO = re.compile(r"[-+]?0[0-9]+\Z")
_OCTAL = re.compile(r"0o[0-7]+\Z")
_HEXADECIMAL = re.compile(r"0x[0-9a-fA-F]+\Z")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?\Z")
_INFINITE = re.compile(r"[-+]?\.(inf|Inf|INF)\Z")
_NOT_A_NUMBER = frozenset({".nan", ".NaN", ".NAN"})
_LONGEST_INT = 80  # digits; int() is quadratic in them and refuses 4300, INT64_MIN has 19


def resolve(text: str, place: Place) -> Scalar:
    """Return what the unquoted scalar `text` means at a place.

    Raises:
        ValueError: a number that is too large for a double, does not fit into 64 bits or must be
            finite there; the message is a phrase that follows "cannot use '…': ".
    """
    if text in _NULL:
        return None
    if text in _TRUE:
        return True
    if text in _FALSE:
        return False
    for pattern, base in ((_DECIMAL, 10), (_OCTAL, 8), (_HEXADECIMAL, 16)):
        if pattern.match(text):
            return _integer(text, base)
    if _FLOAT.match(text) and not has_leading_zero(text):
        number = float(text)
        if math.isfinite(number):
            return number
        raise ValueError(_FINITE)
    special = not_finite(text)
    if special is not None and not may_be_any_double(place):
        raise ValueError(_FINITE)
    return text if special is None else special


_FINITE = "a number must be finite"


def not_finite(text: str) -> float | None:
    """Return the double that YAML's `.inf`, `-.INF`, `.NaN` … spell; None of anything else."""
    if text in _NOT_A_NUMBER:
        return math.nan
    return float(text.replace(".", "")) if _INFINITE.match(text) else None


_NAMED = frozenset({"nodes", "groups", "modes", "machines", "arguments"})
"""Sections whose keys users choose: one that is called `parameters` is none."""


def may_be_any_double(place: Place) -> bool:
    """Whether a number there may be infinite or none: values of parameters, and only those."""
    return any(
        each == "extra_arguments"
        or (each == "parameters" and (index == 0 or place[index - 1] not in _NAMED))
        for index, each in enumerate(place)
    )


def has_leading_zero(text: str) -> bool:
    """Whether this is digits that versions of YAML read as different values."""
    return _LEADING_ZERO.match(text) is not None


def _integer(text: str, base: int) -> int:
    if len(text) <= _LONGEST_INT:
        number = int(text, base)
        if INT64_MIN <= number <= INT64_MAX:
            return number
    raise ValueError("an integer must fit into 64 bits, -2**63 to 2**63-1")


def quote(value: object, *, limit: int = 60) -> str:
    """Spell a value for a message: as YAML would show it, cut to `limit` characters."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, dict):
        return "a mapping"
    if isinstance(value, (list, tuple)):
        return "a list"
    spelled = repr(value)
    return spelled if len(spelled) <= limit else f"{spelled[: limit - 2]}…{spelled[-1]}"
