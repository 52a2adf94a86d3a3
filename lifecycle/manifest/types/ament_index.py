"""The ament resource index: which packages, interfaces and NoDL documents are installed.

Owns: where the index lies and how a resource is found in it, as ament_index_python does, but for a
prefix that AMENT_PREFIX_PATH need not name: wheels install the index under `sys.prefix`. Reads the
file system; needs no ROS.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

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
        if path.is_file():
            return path
    return None


def list_resources(kind: str, prefixes: Sequence[Path]) -> tuple[str, ...]:
    """Return the names of all resources of type `kind`, sorted."""
    names: set[str] = set()
    for prefix in prefixes:
        folder = prefix / _INDEX / kind
        if folder.is_dir():
            # A leading dot marks files that are no resources.
            names.update(each.name for each in folder.iterdir() if not each.name.startswith("."))
    return tuple(sorted(names))
