"""How large a message of a type can get, told by the installed interface definitions alone.

Owns: the bound of a type's serialized size, from the `.idl` file that every interface package
installs, also for what was written as `.msg`. Imports no message package. Reads the file system.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from lifecycle.manifest.types.ament_index import find_resource
from lifecycle.manifest.types.idl import Field, IdlError, parse_struct

_ENCAPSULATION = 4
"""Bytes in front of every serialized message (DDSI-RTPS 10)."""

_LENGTH = 4
_WCHAR = 4
_PRIMITIVES = {
    "boolean": 1,
    "octet": 1,
    "char": 1,
    "int8": 1,
    "uint8": 1,
    "int16": 2,
    "uint16": 2,
    "short": 2,
    "int32": 4,
    "uint32": 4,
    "long": 4,
    "float": 4,
    "wchar": _WCHAR,
    "int64": 8,
    "uint64": 8,
    "double": 8,
}
_MAX_DEPTH = 32
_EXACT_ITEMS = 64  # items of an array that are laid out one by one before padding is estimated


class _UnboundedError(Exception):
    """A field has no bound, or its type cannot be read here."""


def bounded_size(type_: str, prefixes: Sequence[Path]) -> int | None:
    """Return the largest serialized size of a message type, bytes; None if it has no bound.

    None also if the type is not installed here or its definition cannot be read. CDR aligns fields
    by what precedes them, so after a field of variable length the largest padding is counted.

    Args:
        type_: `package/msg/Type`.
        prefixes: where to search, from `ament_index.search_prefixes`.
    """
    layout = _Layout()
    try:
        _add(type_, layout, prefixes, 0)
    except _UnboundedError:
        return None
    return _ENCAPSULATION + layout.offset


@dataclasses.dataclass(slots=True)
class _Layout:
    """Bytes so far; `exact` while every message of the type has this very offset here."""

    offset: int = 0
    exact: bool = True

    def align(self, to: int) -> None:
        self.offset += -self.offset % to if self.exact else to - 1

    def put(self, size: int, count: int = 1) -> None:
        if count:
            self.align(size)
            self.offset += size * count


def _add(type_: str, layout: _Layout, prefixes: Sequence[Path], depth: int) -> None:
    fields = _fields(type_, prefixes) if depth < _MAX_DEPTH else None
    if fields is None:
        raise _UnboundedError
    for field in fields:
        _add_field(field, layout, prefixes, depth)
    if not fields:
        layout.put(1)  # rosidl puts a member into an empty structure


def _add_field(field: Field, layout: _Layout, prefixes: Sequence[Path], depth: int) -> None:
    count = field.length
    if field.is_sequence:
        if field.bound is None:
            raise _UnboundedError
        layout.put(_LENGTH)
        count = field.bound
    if field.type in _PRIMITIVES:
        layout.put(_PRIMITIVES[field.type], count)
    elif field.type in ("string", "wstring"):
        if field.string_bound is None:
            raise _UnboundedError
        width = 1 if field.type == "string" else _WCHAR
        _repeat_text(layout, width * (field.string_bound + 1), count)
    else:
        _repeat(field.type, layout, count, prefixes, depth)
    layout.exact = layout.exact and not field.is_sequence


def _repeat_text(layout: _Layout, content: int, count: int) -> None:
    for _ in range(min(count, 1)):
        layout.put(_LENGTH)
        layout.offset += content
        layout.exact = False
    layout.offset += max(count - 1, 0) * (_LENGTH + _LENGTH - 1 + content)


def _repeat(type_: str, layout: _Layout, count: int, prefixes: Sequence[Path], depth: int) -> None:
    for _ in range(min(count, _EXACT_ITEMS)):
        _add(type_, layout, prefixes, depth + 1)
    if count > _EXACT_ITEMS:
        one = _Layout(exact=False)
        _add(type_, one, prefixes, depth + 1)
        layout.offset += one.offset * (count - _EXACT_ITEMS)
        layout.exact = False


def _fields(type_: str, prefixes: Sequence[Path]) -> tuple[Field, ...] | None:
    """Return the fields of a type, `a/msg/B` or IDL's `a::msg::B`; None if it cannot be read."""
    package, _, rest = type_.replace("::", "/").partition("/")
    index = find_resource("rosidl_interfaces", package, prefixes)
    if index is None or not rest:
        return None
    # <prefix>/share/ament_index/resource_index/rosidl_interfaces/<package>
    path = index.parents[3] / package / f"{rest}.idl"
    try:
        return parse_struct(path.read_text(encoding="utf-8"), rest.rpartition("/")[2])
    except (OSError, UnicodeDecodeError, IdlError):
        return None
