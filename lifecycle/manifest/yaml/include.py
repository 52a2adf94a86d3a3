"""`include:` of manifests: find included files, refuse cycles. `load` reads them.

Looks at the file system for existence only.
"""

from __future__ import annotations

import os
from pathlib import Path

from lifecycle.errors import did_you_mean
from lifecycle.manifest.interface import Findings
from lifecycle.manifest.yaml.document import Document, error
from lifecycle.manifest.yaml.yaml_parser import quote

MAX_DEPTH = 16
"""Manifests that include each other in a row."""

MAX_DOCUMENTS = 256
"""Manifests of one system; included twice counts twice."""


def shown(path: Path) -> str:
    """Return how messages name a file: bytes that are no UTF-8 could be neither shown nor sent."""
    return os.fsencode(path).decode("utf-8", errors="replace")


def _identity(path: Path) -> str:
    """Return a path without links, to recognise a file again."""
    try:
        return os.path.realpath(path)
    except (OSError, ValueError):  # a name that no file can have; opening it reports that
        return str(path)


def locate(entry: Document, chain: tuple[Path, ...], found: Findings) -> Path | None:
    """Return the file that an entry of `include:` names; None after reporting why there is none.

    Args:
        entry: the entry.
        chain: the including manifests, outermost first.
        found: findings are appended here.
    """
    name = entry.text("manifest")
    path = Path(os.path.normpath(chain[-1].parent / name))
    identities = [_identity(each) for each in chain]
    message, hint = "", ""
    if (identity := _identity(path)) in identities:
        round_trip = [*chain[identities.index(identity) :], path]
        names = " → ".join(each.name for each in round_trip)
        message = f"cannot include {quote(name)}: it would include itself, {names}"
    elif len(chain) == MAX_DEPTH:
        message = f"cannot include {quote(name)}: at most {MAX_DEPTH} manifests in a row"
    elif not os.path.exists(path):
        message = f"cannot include {quote(name)}: there is no file {quote(str(path), limit=200)}"
        hint = did_you_mean(path.name, _siblings(path))
    elif path.is_dir():
        message = f"cannot include {quote(name)}: it is a directory"
    if not message:
        return path
    found.append(error("manifest.include", entry.at(("manifest",)), message, hint))
    return None


def _siblings(path: Path) -> list[str]:
    try:
        return sorted(os.listdir(path.parent))  # noqa: PTH208 - names, not paths
    except (OSError, ValueError):  # no such folder, or not ours to read: there is no suggestion
        return []
