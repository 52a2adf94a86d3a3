"""Installed packages, interface types and type hashes (REP-2016).

Owns: where the ament resource index is and how a resource is found in it, as ament_index_python
does, but for a prefix that AMENT_PREFIX_PATH need not name: wheels install the index under
`sys.prefix`. The type hash of an interface, from the `share/<package>/<kind>/<Type>.json` that
rosidl installs beside every definition. Imports no message package.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath

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


def types_of(package: str, prefixes: Sequence[Path]) -> tuple[str, ...] | None:
    """Return what a package declares, `msg/Image`, each once; None if it is not installed."""
    found = find_resource(_RESOURCE, package, prefixes)
    lines = () if found is None else found.read_text(encoding="utf-8").split()
    types = tuple(dict.fromkeys(str(PurePosixPath(line).with_suffix("")) for line in lines))
    return None if found is None else types


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
    package, _, rest = type_.partition("/")
    index = find_resource(_RESOURCE, package, prefixes) if rest else None
    if index is None:
        return ""
    # <prefix>/share/ament_index/resource_index/rosidl_interfaces/<package>
    path = index.parents[3] / package / f"{rest}.json"
    try:
        listed = json.loads(path.read_text("utf-8"))["type_hashes"]
        known = {str(each["type_name"]): str(each["hash_string"]) for each in listed}
    except (OSError, ValueError, RecursionError, KeyError, TypeError):
        return ""
    parts = _PARTS.get(rest.partition("/")[0], ())
    return join([known.get(f"{type_}{part}", "") for part in parts])
