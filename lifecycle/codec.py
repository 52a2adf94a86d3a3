"""JSON in and out for the package's frozen dataclasses.

Owns: the one way a dataclass becomes JSON (control channel, reports, files) and comes back typed.
Enums travel as their values, tuples as arrays, None as null. Imports nothing of the package.
"""

from __future__ import annotations

from typing import TypeVar

import msgspec

T = TypeVar("T")


def to_json(value: object) -> bytes:
    """Encode a dataclass (or a container of them) as compact UTF-8 JSON."""
    return msgspec.json.encode(value)


def from_json(data: bytes | str, type_: type[T]) -> T:
    """Decode and validate JSON as `type_`.

    Raises:
        ValueError: the JSON is malformed or does not fit (msgspec.ValidationError).
    """
    return msgspec.json.decode(data, type=type_)


def to_plain(value: object) -> object:
    """Return `value` as dicts, lists and scalars, as JSON would hold it."""
    return msgspec.to_builtins(value)
