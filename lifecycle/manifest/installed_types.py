"""Installed packages, interface types, type hashes (REP-2016) and upper bounds of message sizes.

Owns: where the ament resource index is and how a resource is found in it, as ament_index_python
does, but for a prefix that AMENT_PREFIX_PATH need not name: wheels install the index under
`sys.prefix`. The three answers to "is there a `sensor_msgs/msg/Image`?". The type hash of an
interface, from the `share/<package>/<kind>/<Type>.json` that rosidl installs beside every
definition, and how the hashes of a service's and an action's messages are put together.

And the upper bound of a type's serialized size, from the same file, which describes each field
(type_description_interfaces/msg/FieldType).

Imports no message package, so that a manifest is checked without ROS installed or sourced. Reads
the file system.
"""

from __future__ import annotations

import enum
import json
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import msgspec

from lifecycle.errors import nearest

_INDEX = Path("share", "ament_index", "resource_index")


def search_prefixes(environment: Mapping[str, str] | None = None) -> tuple[Path, ...]:
    """Return the prefixes to search, first one first: AMENT_PREFIX_PATH, then `sys.prefix`."""
    variables = os.environ if environment is None else environment
    listed = variables.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    return tuple(dict.fromkeys(Path(each) for each in (*listed, sys.prefix) if each))


def find_resource(kind: str, name: str, prefixes: Sequence[Path]) -> Path | None:
    """Return the file of resource `name` of type `kind` in the first prefix that has it."""
    for prefix in prefixes:
        path = prefix / _INDEX / kind / name
        if os.path.isfile(path):
            return path
    return None


def list_resources(kind: str, prefixes: Sequence[Path]) -> tuple[str, ...]:
    """Return the names of all resources of type `kind`, sorted."""
    names: set[str] = set()
    for prefix in prefixes:
        folder = prefix / _INDEX / kind
        if os.path.isdir(folder):
            # A leading dot marks files that are no resources.
            names.update(each.name for each in folder.iterdir() if not each.name.startswith("."))
    return tuple(sorted(names))


_RESOURCE = "rosidl_interfaces"


class TypeStatus(enum.Enum):
    """What the index holds of a type."""

    EXISTS = "exists"
    NO_SUCH_TYPE = "no such type"  # the package is installed, the type is not in it
    NOT_INSTALLED = "package not installed"


class TypeLookup(msgspec.Struct, frozen=True, kw_only=True):
    """The answer for one type.

    Attributes:
        nearest: an installed type (NO_SUCH_TYPE) or package (NOT_INSTALLED) with a similar name;
            empty if there is none.
    """

    status: TypeStatus
    nearest: str = ""


def look_up(type_: str, prefixes: Sequence[Path]) -> TypeLookup:
    """Look a type up.

    Args:
        type_: `package/msg/Type`, `package/srv/Type` or `package/action/Type`.
        prefixes: where to search, from `search_prefixes`.
    """
    package, _, name = type_.partition("/")
    found = find_resource(_RESOURCE, package, prefixes)
    if found is None:
        import difflib  # only a mistake needs it

        # Packages share endings (`_msgs`, `_interfaces`), so only a near miss is a hint.
        known = list_resources(_RESOURCE, prefixes)
        similar = next(iter(difflib.get_close_matches(package, known, n=1, cutoff=0.85)), "")
        return TypeLookup(status=TypeStatus.NOT_INSTALLED, nearest=similar)
    types = _types(found)
    if name in types:
        return TypeLookup(status=TypeStatus.EXISTS)
    # A type of the same kind is preferred: `msg/Imu` for `msg/IMU`, not `srv/SetCameraInfo`.
    kind = name.partition("/")[0]
    same_kind = [each for each in types if each.startswith(f"{kind}/")]
    similar = nearest(name, same_kind) or nearest(name, types)
    return TypeLookup(
        status=TypeStatus.NO_SUCH_TYPE, nearest=f"{package}/{similar}" if similar else ""
    )


def _types(resource: Path) -> tuple[str, ...]:
    """Return what a package declares: `msg/Image`, each once, in the index's order."""
    lines = resource.read_text(encoding="utf-8").split()
    return tuple(dict.fromkeys(str(PurePosixPath(line).with_suffix("")) for line in lines))


_SERVICE = ("_Request", "_Response")
_PARTS = {
    "msg": ("",),
    "srv": _SERVICE,
    "action": (
        *(f"_SendGoal{each}" for each in _SERVICE),
        *(f"_GetResult{each}" for each in _SERVICE),
        "_FeedbackMessage",
    ),
}
"""The messages on the wire, by the kind of an interface."""


def join(hashes: Sequence[str]) -> str:
    """Put the hashes of one interface's messages together; empty if one of them is not known.

    Args:
        hashes: of a message; of a service's request and response; of an action's goal request and
            response, result request and response, and feedback message.
    """
    return " ".join(hashes) if all(hashes) else ""


def installed_hash(type_: str, prefixes: Sequence[Path]) -> str:
    """Return the hash of a type as it is installed here, `RIHS01_df66…`, for `join` where several.

    Empty if the type is not installed here, or by a distribution that has no hashes (before Iron).

    Args:
        type_: `package/msg/Type`, `package/srv/Type` or `package/action/Type`.
        prefixes: where to search, from `search_prefixes`.
    """
    parts = _PARTS.get(type_.partition("/")[2].partition("/")[0], ())
    try:
        listed = _description(type_, prefixes)["type_hashes"]
        known = {str(each["type_name"]): str(each["hash_string"]) for each in listed}
    except (KeyError, TypeError):
        return ""
    return join([known.get(f"{type_}{part}", "") for part in parts])


def _description(type_: str, prefixes: Sequence[Path]) -> Any:
    """Return what rosidl has installed of a type as JSON; None if it cannot be read."""
    package, _, rest = type_.partition("/")
    index = find_resource(_RESOURCE, package, prefixes) if rest else None
    if index is None:
        return None
    try:
        # <prefix>/share/ament_index/resource_index/rosidl_interfaces/<package>
        return json.loads((index.parents[3] / package / f"{rest}.json").read_text("utf-8"))
    except (OSError, ValueError, RecursionError):
        return None


_ENCAPSULATION = 4
"""Bytes in front of every serialized message (DDSI-RTPS 10)."""

_LENGTH = 4
_WCHAR = 4
_SIZES = {
    **dict(enumerate((1, 1, 2, 2, 4, 4, 8, 8, 4, 8), start=2)),  # int8 … uint64, float, double
    13: 1,
    14: _WCHAR,
    15: 1,
    16: 1,  # char, wchar, boolean, byte
}
_CHARACTERS = {21: 1, 22: _WCHAR}
_NESTED = 1
_FORM, _ARRAY, _BOUNDED = 48, 1, 2
"""type_description_interfaces/msg/FieldType: bytes by type id, bytes of a character by that of a
bounded string, and in steps of 48 a type's array, its bounded and its unbounded sequence."""

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
        prefixes: where to search, from `installed_types.search_prefixes`.
    """
    layout = _Layout()
    try:
        _add(type_, layout, prefixes, 0)
    except (_UnboundedError, KeyError, TypeError):  # or a description that is none
        return None
    return _ENCAPSULATION + layout.offset


class _Layout(msgspec.Struct):
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
    if depth == _MAX_DEPTH:
        raise _UnboundedError
    fields = _description(type_, prefixes)["type_description_msg"]["type_description"]["fields"]
    for each in fields:
        _add_field(each["type"], layout, prefixes, depth)
    if not fields:
        layout.put(1)  # rosidl puts a member into an empty structure


def _add_field(
    field: Mapping[str, Any], layout: _Layout, prefixes: Sequence[Path], depth: int
) -> None:
    form, of = divmod(_count(field["type_id"]), _FORM)
    if form > _BOUNDED:
        raise _UnboundedError
    count = _count(field["capacity"]) if form else 1
    if form == _BOUNDED:
        layout.put(_LENGTH)
    if of in _CHARACTERS:
        _repeat_text(layout, _CHARACTERS[of] * (_count(field["string_capacity"]) + 1), count)
    elif of == _NESTED:
        _repeat(str(field["nested_type_name"]), layout, count, prefixes, depth)
    else:
        layout.put(_SIZES[of], count)
    layout.exact = layout.exact and form != _BOUNDED


def _count(value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise _UnboundedError
    return value


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
