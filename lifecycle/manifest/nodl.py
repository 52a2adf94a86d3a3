"""NoDL v2 documents as interfaces: references, includes, endpoints and parameter declarations.

Owns: resolving references (`local://relative/path`, `nodl://package/name`) with the documents they
include, and what of NoDL differs from a manifest's inline interface: types without their kind,
policies that must be written, types of generate_parameter_library. The format is nodl.schema.yaml
of ros-tooling/nodl 2.0 and parameter.schema.yaml; beside these differences it is validated and
built as an inline interface is. What this package does not use of it is reported as a warning;
what breaks it is an error.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path

from msgspec.structs import replace

from lifecycle.errors import did_you_mean, nearest
from lifecycle.manifest.diagnostics import Diagnostic, ManifestError, Position, Severity
from lifecycle.manifest.installed_types import find_resource, list_resources, search_prefixes
from lifecycle.manifest.interface import build_inline
from lifecycle.manifest.model import Endpoint, EndpointKind, Interface, ParameterDeclaration
from lifecycle.manifest.qos import POLICIES
from lifecycle.manifest.schema import validate
from lifecycle.manifest.yaml.document import Document, Place, Value, error, warning
from lifecycle.manifest.yaml.source import read_document
from lifecycle.manifest.yaml.yaml_parser import quote

NODL_VERSION = 2

_NOT_OURS = ("nodl_version", "description", "codegen", "include")
_UNCHECKED = ("additional_constraints", "validation")
_PARAMETER_KEYS = ("type", "default_value", "description", "read_only")
_FIXED_SIZE = re.compile(r"(string|int_array|double_array|string_array)_fixed_[1-9][0-9]*")

_Entries = dict[str, Value]


class _Reader:
    """Reads one document, its includes left out.

    Attributes:
        interface: empty after an error.
        found: errors and warnings, each at its place.
    """

    def __init__(self, document: Document) -> None:
        self._document = document
        self.interface = Interface()
        self.found: list[Diagnostic] = []
        root = document.root
        entries = self._entries((), root, [*_NOT_OURS, "parameters", *map(_key, EndpointKind)])
        version = entries.get("nodl_version")
        if version is None:
            self._error((), "cannot do without the key 'nodl_version'", "add 'nodl_version: 2'")
        elif version.data != NODL_VERSION:
            message = f"cannot use nodl_version {quote(version.data)}; allowed: {NODL_VERSION}"
            self._error(("nodl_version",), message)
        for key in _NOT_OURS:
            entries.pop(key, None)
        for kind in EndpointKind:
            if (each := entries.get(kind.value)) and isinstance(each.data, tuple):
                items = enumerate(each.data)
                data = tuple(self._endpoint(kind, (kind.value, i), item) for i, item in items)
                entries[kind.value] = replace(each, data=data)
        if (each := entries.get("parameters")) and isinstance(each.data, Mapping):
            parameters = {
                name: self._parameter(name, ("parameters", name), value)
                for name, value in each.data.items()
            }
            known = {name: value for name, value in parameters.items() if value is not None}
            entries["parameters"] = replace(each, data=known)
        inline = replace(document, root=replace(root, data=entries))
        found = list(validate(inline, definition="Interface"))
        if not found:
            self.interface = build_inline(inline, found)
        rules = {"manifest.duplicate-name": "nodl.duplicate"}
        self.found += [replace(each, rule=rules.get(each.rule, "nodl.invalid")) for each in found]
        if any(each.severity is Severity.ERROR for each in self.found):
            self.interface = Interface()

    def _endpoint(self, kind: EndpointKind, place: Place, value: Value) -> Value:
        if not isinstance(value.data, Mapping):
            return value
        known = ("name", "type", "description", *(() if kind.is_action else ("qos",)))
        entries = self._entries(place, value, known)
        if (type_ := entries.get("type")) and type_.text.count("/") == 1:
            word = "msg" if kind.is_topic else "action" if kind.is_action else "srv"
            entries["type"] = _text(type_, type_.text.replace("/", f"/{word}/"))
        if kind.is_topic and "qos" not in entries:
            self._error(place, f"cannot do without the key 'qos' in a {kind.noun}")
        qos, at = entries.get("qos"), (*place, "qos")
        if qos and not isinstance(qos.data, Mapping):
            self._error(at, f"cannot use {quote(qos.plain())} as a QoS profile; write a mapping")
        elif qos and isinstance(qos.data, Mapping):
            entries["qos"] = replace(qos, data=self._entries(at, qos, POLICIES))
            for name in ("history", "reliability"):
                if name not in qos.data:
                    self._error(at, f"cannot do without the key {name!r} in a QoS profile")
            history = qos.data.get("history")
            if history and history.data == "KEEP_LAST" and "depth" not in qos.data:
                self._error(at, "cannot do without 'depth' under KEEP_LAST", "add 'depth: 10'")
        return replace(value, data=entries)

    def _parameter(self, name: str, place: Place, value: Value) -> Value | None:
        """Return a declaration as a manifest has it; None for what declares no parameter."""
        if not isinstance(value.data, Mapping):
            return value
        entries = self._entries(place, value, (*_PARAMETER_KEYS, *_UNCHECKED))
        type_ = entries.get("type")
        if type_ and (fixed := _FIXED_SIZE.fullmatch(type_.text)):
            self._unchecked((*place, "type"), f"the size in type {type_.text!r}")
            entries["type"] = _text(type_, fixed[1])
        for key in _UNCHECKED:
            if (unchecked := entries.pop(key, None)) and unchecked.data is not None:
                self._unchecked((*place, key), f"{key!r}")
        if name.startswith("__map_") or ".__map_" in name:
            self._unchecked(place, f"the parameter map {name!r}")
            return None
        if type_ and type_.text == "none":
            return None
        return replace(value, data=entries)

    def _entries(self, place: Place, value: Value, known: Iterable[str]) -> _Entries:
        """Return the entries of a mapping that NoDL knows, and warn of the others."""
        assert isinstance(value.data, Mapping)
        words = list(known)
        for key in value.data:
            if key not in words:
                at = self._document.key_at((*place, key))
                message = f"cannot use the key {key!r}: NoDL {NODL_VERSION} has none; it is ignored"
                self.found.append(
                    warning("nodl.unknown-key", at, message, did_you_mean(key, words))
                )
        return {key: each for key, each in value.data.items() if key in words}

    def _unchecked(self, place: Place, what: str) -> None:
        message = f"cannot check {what}; parameters are checked by type only"
        self.found.append(warning("nodl.unchecked", self._document.at(place), message))

    def _error(self, place: Place, message: str, hint: str = "") -> None:
        self.found.append(error("nodl.invalid", self._document.at(place), message, hint))


def _key(kind: EndpointKind) -> str:
    return kind.value


def _text(value: Value, text: str) -> Value:
    return replace(value, data=text, text=text)


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
    reading = _NodlReading(search_prefixes(environment))
    reading.follow(reference, Path(base), at, ())
    reading.report_collisions()
    interface = Interface(
        endpoints=tuple(reading.endpoints),
        parameters=tuple(reading.parameters),
        source=reference,
        has_all_parameters=True,
    )
    return interface, tuple(reading.found)


class _NodlReading:
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
        reader = _Reader(document)
        self.found += reader.found
        self.endpoints += reader.interface.endpoints
        self.parameters += reader.interface.parameters
        includes = document.find(("include",))
        listed = includes.data if includes else ()
        if not isinstance(listed, tuple):
            self._error("invalid", document.at(("include",)), "cannot include what is no list")
            return
        for index in range(len(listed)):
            where = document.at(("include", index, "ref"))
            ref = document.find(("include", index, "ref"))
            if ref is not None and isinstance(ref.data, str) and ref.data:
                self.follow(ref.data, path.parent, where, (*chain, identity))
            else:
                self._error("invalid", where, "cannot do without the key 'ref' in an include")

    def report_collisions(self) -> None:
        """Refuse a name that two entries of one list declare (nodl.schema.yaml, `include`)."""
        first: dict[tuple[str, str], Position] = {}
        entries = [(each.kind.noun, each.name, each.at) for each in self.endpoints]
        entries += [("parameter", each.name, each.at) for each in self.parameters]
        for what, name, at in entries:
            other = first.setdefault((what, name), at)
            if other is not at:
                place = f"{other.spelled}"
                message = f"cannot declare {what} {name!r} twice; the first stands at {place}"
                self._error("duplicate", at, message, "remove one")

    def _locate(self, reference: str, base: Path, at: Position) -> Path | None:
        scheme, _, body = reference.partition("://")
        if scheme == "local" and body:
            path = base / body
            if not os.path.exists(path):
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


def nearest_file(path: Path) -> str:
    """Return a hint that names the file, beside one that is missing, with the nearest name.

    Only files of the same kind count, and only up to the first dot, where kinds begin.
    """
    stem, _, kind = path.name.partition(".")
    files = [each.name.partition(".") for each in path.parent.glob(f"*.{kind}")]
    stems = {each: f"{each}{dot}{rest}" for each, dot, rest in files if rest == kind}
    found = nearest(stem, sorted(stems))
    return f"did you mean {stems[found]!r}?" if found else ""
