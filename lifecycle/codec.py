"""JSON encoding and decoding of the package's types (msgspec.Struct), and ranges for their schemas.

Owns: the one way a value becomes JSON (control channel, reports, files) and becomes typed
again. Enums travel as their values, tuples as arrays, None as null. Owns also ranges of integers,
which reading enforces and schemas have; and reading the tables that ship inside the package:
`lifecycle/network/data/` holds transcribed facts with their sources, nothing is computed into them.
Imports nothing of the package.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec

T = TypeVar("T")


def says(**keywords: object) -> msgspec.Meta:
    """Return what a schema requires of a value, for `Annotated`: `says(const=1)`."""
    return msgspec.Meta(extra_json_schema=keywords)


LARGEST = 2**63 - 1
"""JSON of ours has no larger integer."""

Count = Annotated[int, msgspec.Meta(ge=0, le=LARGEST)]
Positive = Annotated[int, msgspec.Meta(ge=1, le=LARGEST)]
DomainId = Annotated[int, msgspec.Meta(ge=0, le=232)]
DscpValue = Annotated[int, msgspec.Meta(ge=0, le=63)]
FlowLabel = Annotated[int, msgspec.Meta(ge=0, le=0xFFFFF)]
Octet = Annotated[int, msgspec.Meta(ge=0, le=0xFF)]
UInt32 = Annotated[int, msgspec.Meta(ge=0, le=0xFFFFFFFF)]
Port = Annotated[int, msgspec.Meta(ge=1, le=65535)]
PortOrNone = Annotated[int, msgspec.Meta(ge=0, le=65535)]


def to_json(value: object) -> bytes:
    """Encode a value (or a container of them) as compact UTF-8 JSON."""
    return msgspec.json.encode(value)


def from_json(data: bytes | str, type_: type[T], *, longest: int | None = None) -> T:
    """Decode and validate JSON as `type_`; nothing that it may hold raises anything else.

    How deep it may nest is bounded by `type_`, and where a field is passed over by Python's
    recursion limit.

    Args:
        data: from anywhere.
        type_: what it must be.
        longest: bytes, or characters of a text, that are read at all; None for what we wrote.

    Raises:
        ValueError: the JSON is too long or too deep, malformed, or does not fit
            (msgspec.ValidationError).
    """
    if longest is not None and len(data) > longest:
        raise ValueError(f"{len(data)} characters of JSON; at most {longest} are read")
    try:
        return decoder(type_).decode(data)  # type: ignore[no-any-return, arg-type]
    except (RecursionError, OverflowError, MemoryError) as error:
        raise ValueError("JSON that is nested too deep, or a number too large") from error


@functools.cache
def decoder(type_: Any) -> Any:
    """Return what decodes a type: made once, which takes 10 ms for a type of many others."""
    return msgspec.json.Decoder(type_)


def to_plain(value: object) -> object:
    """Return `value` as dicts, lists and scalars, as JSON would hold it."""
    return msgspec.to_builtins(value)


def read_table(name: str, type_: type[T]) -> T:
    """Read `lifecycle/network/data/<name>.json` as `type_`.

    Raises:
        FileNotFoundError: no such table.
        ValueError: the file does not fit `type_`.
    """
    file = Path(__file__).parent / "network" / "data" / f"{name}.json"
    return from_json(file.read_bytes(), type_)
