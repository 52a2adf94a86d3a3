"""NoDL v2 documents in place of an inline interface.

Owns: resolving references (`local://relative/path`, `nodl://package/name`) with the documents they
include, and turning a document into an `Interface`. The document format is nodl.schema.yaml of
ros-tooling/nodl 2.0. What this package does not use of it is reported as a warning; what breaks
it is an error. Writing NoDL (`to_nodl`) is left for later and belongs here as well.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path

from lifecycle.manifest.diagnostics import Diagnostic, ManifestError, Position
from lifecycle.manifest.model import Endpoint, Interface, ParameterDeclaration
from lifecycle.manifest.nodl.entities import NodlReader
from lifecycle.manifest.schema.message_text import did_you_mean, nearest
from lifecycle.manifest.types.ament_index import find_resource, list_resources, search_prefixes
from lifecycle.manifest.yaml.document import Document, error
from lifecycle.manifest.yaml.source import read_document

MAX_DOCUMENTS = 100
"""Documents that one reference may pull in."""

_RESOURCE = "nodl"  # ament_nodl_register() installs documents as nodl/<package>__<name>


def read_interface(
    reference: str,
    *,
    base: str | Path,
    at: Position,
    environment: Mapping[str, str] | None = None,
) -> tuple[Interface, tuple[Diagnostic, ...]]:
    """Read the interface that a reference names, with everything it includes.

    Args:
        reference: `local://PATH`, relative to `base`, or `nodl://PACKAGE/NAME` in the ament index.
        base: directory of the document that holds the reference.
        at: where that document holds it.
        environment: for AMENT_PREFIX_PATH; this process's if None.

    Returns:
        The interface, with `source` set, and every finding. After an error the interface holds
        what could be read.
    """
    reading = _Reading(search_prefixes(environment))
    reading.follow(reference, Path(base), at, ())
    reading.report_collisions()
    interface = Interface(
        endpoints=tuple(reading.endpoints), parameters=tuple(reading.parameters), source=reference
    )
    return interface, tuple(reading.found)


class _Reading:
    """One walk over a document and its includes; collects entities and findings."""

    def __init__(self, prefixes: tuple[Path, ...]) -> None:
        self._prefixes = prefixes
        self._read: set[Path] = set()
        self.endpoints: list[Endpoint] = []
        self.parameters: list[ParameterDeclaration] = []
        self.found: list[Diagnostic] = []

    def follow(self, reference: str, base: Path, at: Position, chain: tuple[Path, ...]) -> None:
        """Read one reference; `chain` holds the documents that led to it."""
        path = self._locate(reference, base, at)
        if path is None:
            return
        identity = path.resolve()
        if identity in chain:
            names = " → ".join(each.name for each in (*chain[chain.index(identity) :], identity))
            self._error("cycle", at, f"cannot include {reference!r} in itself: {names}")
            return
        if identity in self._read:
            self._error("twice", at, f"cannot include {reference!r} twice", "remove one include")
            return
        if len(self._read) == MAX_DOCUMENTS:
            self._error("limit", at, f"cannot include more than {MAX_DOCUMENTS} documents")
            return
        self._read.add(identity)
        try:
            document = read_document(path)
        except ManifestError as problem:
            self.found += problem.diagnostics
            return
        reader = NodlReader(document)
        self.endpoints += reader.endpoints
        self.parameters += reader.parameters
        self.found += reader.found
        for included, where in _includes(document, reader):
            self.follow(included, path.parent, where, (*chain, identity))

    def report_collisions(self) -> None:
        """Refuse a name that two entries of one list declare (nodl.schema.yaml, `include`)."""
        first: dict[tuple[str, str], Position] = {}
        entries = [(each.kind.noun, each.name, each.at) for each in self.endpoints]
        entries += [("parameter", each.name, each.at) for each in self.parameters]
        for what, name, at in entries:
            other = first.setdefault((what, name), at)
            if other is not at:
                place = f"{other.file}:{other.line}:{other.column}"
                message = f"cannot declare {what} {name!r} twice; the first stands at {place}"
                self._error("duplicate", at, message, "remove one")

    def _locate(self, reference: str, base: Path, at: Position) -> Path | None:
        scheme, _, body = reference.partition("://")
        if scheme == "local" and body:
            path = base / body
            if not os.path.exists(path):  # noqa: PTH110 - Path.exists() raises for a name too long
                message = f"cannot find {reference!r}: there is no file {str(path)!r}"
                hint = nearest_file(path)
                self._error("not-found", at, message, hint)
                return None
            return path
        if scheme == "nodl":
            return self._indexed(reference, body, at)
        message = f"cannot follow {reference!r}; write local://PATH or nodl://PACKAGE/NAME"
        self._error("reference", at, message)
        return None

    def _indexed(self, reference: str, body: str, at: Position) -> Path | None:
        package, _, name = body.partition("/")
        if not package or not name or "/" in name:
            self._error("reference", at, f"cannot follow {reference!r}; write nodl://PACKAGE/NAME")
            return None
        found = find_resource(_RESOURCE, f"{package}__{name}", self._prefixes)
        if found is None:
            known = [
                "nodl://" + each.replace("__", "/", 1)
                for each in list_resources(_RESOURCE, self._prefixes)
            ]
            message = f"cannot find {reference!r} in the ament index"
            hint = did_you_mean(reference, known) or (
                f"source the workspace that installs {package}, so that AMENT_PREFIX_PATH names it"
            )
            self._error("not-found", at, message, hint)
        return found

    def _error(self, rule: str, at: Position, message: str, hint: str = "") -> None:
        self.found.append(error(f"nodl.{rule}", at, message, hint))


def _includes(document: Document, reader: NodlReader) -> Iterator[tuple[str, Position]]:
    for index, reference in reader.includes:
        yield reference, document.at(("include", index, "ref"))


def nearest_file(path: Path) -> str:
    """Return a hint that names the file, beside one that is missing, with the nearest name.

    Only files of the same kind count, and only up to the first dot, where kinds begin.
    """
    stem, _, kind = path.name.partition(".")
    files = [each.name.partition(".") for each in path.parent.glob(f"*.{kind}")]
    stems = {each: f"{each}{dot}{rest}" for each, dot, rest in files if rest == kind}
    found = nearest(stem, sorted(stems))
    return f"did you mean {stems[found]!r}?" if found else ""
