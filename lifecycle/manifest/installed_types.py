"""Installed packages, interface types and type hashes (REP-2016).

Owns: where the ament resource index is and how a resource is found in it, as ament_index_python
does, but for a prefix that AMENT_PREFIX_PATH need not name: wheels install the index under
`sys.prefix`. The type hash of an interface, from the `share/<package>/<kind>/<Type>.json` that
rosidl installs beside every definition. Imports no message package.
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
    """Look a type up, `package/msg/Type`, in the prefixes of `search_prefixes`."""
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
    """Put the hashes of one interface's messages together; empty if one of them is not known."""
    return " ".join(hashes) if all(hashes) else ""


def installed_hash(type_: str, prefixes: Sequence[Path]) -> str:
    """Return the hash of a type as it is installed here, `RIHS01_df66…`, for `join` where several.

    Empty if the type is not installed here, or by a distribution that has no hashes (before Iron).
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
