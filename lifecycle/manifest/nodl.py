"""NoDL v2 documents as interfaces: references, includes, endpoints and parameter declarations.

Owns: resolving references (`local://relative/path`, `nodl://package/name`) with the documents they
include, and turning a document into an `Interface`. The format is nodl.schema.yaml of
ros-tooling/nodl 2.0, with its field names and defaults, and parameter.schema.yaml (the shape of
generate_parameter_library). What this package does not use of it is reported as a warning; what
breaks it is an error. Writing NoDL (`to_nodl`) is left for later and belongs here as well.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from lifecycle.manifest.diagnostics import Diagnostic, ManifestError, Position
from lifecycle.manifest.installed_types import find_resource, list_resources, search_prefixes
from lifecycle.manifest.model import (
    Endpoint,
    EndpointKind,
    Interface,
    ParameterDeclaration,
    ParameterValue,
)
from lifecycle.manifest.qos import (
    PRESETS,
    Durability,
    History,
    Liveliness,
    QosProfile,
    Reliability,
    not_written,
    problems,
)
from lifecycle.manifest.schema import did_you_mean, nearest
from lifecycle.manifest.yaml.document import Document, Place, error, warning
from lifecycle.manifest.yaml.source import read_document
from lifecycle.manifest.yaml.yaml_parser import quote

NODL_VERSION = 2

_TYPE_KINDS = {
    EndpointKind.PUBLISHER: "msg",
    EndpointKind.SUBSCRIPTION: "msg",
    EndpointKind.SERVICE_SERVER: "srv",
    EndpointKind.SERVICE_CLIENT: "srv",
    EndpointKind.ACTION_SERVER: "action",
    EndpointKind.ACTION_CLIENT: "action",
}
_TYPE = re.compile(r"([a-zA-Z][a-zA-Z0-9_]*)(?:/(msg|srv|action))?/([A-Za-z][a-zA-Z0-9_]*)")
_TOP_KEYS = (
    "nodl_version",
    "description",
    "codegen",
    "include",
    "parameters",
    *(kind.value for kind in EndpointKind),
)
_POLICIES = {
    "history": History,
    "reliability": Reliability,
    "durability": Durability,
    "liveliness": Liveliness,
}
_DURATIONS = ("deadline_ns", "lifespan_ns", "liveliness_lease_duration_ns")
_PARAMETER_KEYS = (
    "type",
    "default_value",
    "description",
    "read_only",
    "additional_constraints",
    "validation",
)
_PARAMETER_TYPES = (
    "bool",
    "int",
    "double",
    "string",
    "none",
    "bool_array",
    "byte_array",
    "int_array",
    "double_array",
    "string_array",
)
_FIXED_SIZE = re.compile(r"(string|int_array|double_array|string_array)_fixed_[1-9][0-9]*")


class NodlReader:
    """Reads one document.

    Attributes:
        endpoints: every endpoint that could be read, in the order of `EndpointKind`.
        parameters: every parameter that could be read.
        includes: (index, reference) of each include.
        found: errors and warnings, each at its place.
    """

    def __init__(self, document: Document) -> None:
        self._document = document
        self.endpoints: list[Endpoint] = []
        self.parameters: list[ParameterDeclaration] = []
        self.includes: list[tuple[int, str]] = []
        self.found: list[Diagnostic] = []
        root = self._mapping((), "a NoDL document")
        self._version(root)
        self._unknown((), root, _TOP_KEYS)
        for index in range(len(self._items(("include",)))):
            self._include(("include", index), index)
        for kind in EndpointKind:
            for index in range(len(self._items((kind.value,)))):
                self._endpoint(kind, (kind.value, index))
        if "parameters" in root:
            for name in self._mapping(("parameters",), "parameters"):
                self._parameter(name, ("parameters", name))

    def _version(self, root: Mapping[str, object]) -> None:
        if "nodl_version" not in root:
            self._error((), "cannot do without the key 'nodl_version'", "add 'nodl_version: 2'")
        elif (value := self._data(("nodl_version",))) != NODL_VERSION:
            message = f"cannot use nodl_version {quote(value)}; allowed: {NODL_VERSION}"
            self._error(("nodl_version",), message)

    def _include(self, place: Place, index: int) -> None:
        entry = self._mapping(place, "an include")
        self._unknown(place, entry, ("ref",))
        if reference := self._text((*place, "ref"), required=True):
            self.includes.append((index, reference))

    # -- endpoints

    def _endpoint(self, kind: EndpointKind, place: Place) -> None:
        entry = self._mapping(place, f"a {kind.noun}")
        if not entry:
            return
        is_action = kind in (EndpointKind.ACTION_SERVER, EndpointKind.ACTION_CLIENT)
        is_topic = kind in (EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION)
        self._unknown(
            place, entry, ("name", "type", "description", *(() if is_action else ("qos",)))
        )
        name = self._text((*place, "name"), required=True)
        type_ = self._type(kind, (*place, "type"))
        qos: QosProfile | None = None
        if "qos" in entry and not is_action:
            qos = self._qos((*place, "qos"))
        elif is_topic:
            self._error(place, f"cannot do without the key 'qos' in a {kind.noun}")
        elif not is_action:
            qos = PRESETS["services_default"]
        if name and type_ and (qos or is_action):
            self.endpoints.append(
                Endpoint(
                    kind=kind,
                    name=name,
                    type=type_,
                    qos=qos,
                    qos_defaults=() if is_action else not_written(self._keys((*place, "qos"))),
                    at=self._document.at(place),
                )
            )

    def _type(self, kind: EndpointKind, place: Place) -> str:
        text = self._text(place, required=True)
        match = _TYPE.fullmatch(text)
        wanted = _TYPE_KINDS[kind]
        if text and (match is None or match[2] not in (None, wanted)):
            allowed = f"a {kind.noun} has a type package/{wanted}/Type"
            self._error(place, f"cannot use type {quote(text)}; {allowed}")
        if match is None or match[2] not in (None, wanted):
            return ""
        return f"{match[1]}/{wanted}/{match[3]}"

    def _qos(self, place: Place) -> QosProfile | None:
        entry = self._mapping(place, "a QoS profile")
        self._unknown(place, entry, (*_POLICIES, "depth", *_DURATIONS))
        before = len(self.found)
        fields: dict[str, object] = {}
        for name in ("history", "reliability"):
            if name not in entry:
                self._error(place, f"cannot do without the key {name!r} in a QoS profile")
        for name, policy in _POLICIES.items():
            if name in entry:
                allowed = [each.value for each in policy if each.value != "UNKNOWN"]
                value = self._word((*place, name), allowed)
                fields[name] = policy(value) if value else None
        for name in ("depth", *_DURATIONS):
            if name in entry:
                number = self._number((*place, name))
                # NoDL and rmw alike: a duration of zero is none.
                fields[name] = number if name == "depth" else number or None
        if fields.get("history") is not History.KEEP_LAST:
            fields.setdefault("depth", 0)
        elif "depth" not in entry:
            self._error(place, "cannot do without 'depth' under KEEP_LAST", "add 'depth: 10'")
        if len(self.found) > before:
            return None
        default = PRESETS["default"]
        profile = QosProfile(
            **{name: fields.get(name, getattr(default, name)) for name in QosProfile.__slots__}  # type: ignore[arg-type]
        )
        for problem in problems(profile):
            self._error(place, f"cannot {problem}")
        return profile

    # -- parameters

    def _parameter(self, name: str, place: Place) -> None:
        entry = self._mapping(place, "a parameter")
        if not entry:
            return
        self._unknown(place, entry, _PARAMETER_KEYS)
        written = self._text((*place, "type"), required=True)
        fixed = _FIXED_SIZE.fullmatch(written)
        type_ = fixed[1] if fixed else written
        if written and type_ not in _PARAMETER_TYPES:
            hint = did_you_mean(written, _PARAMETER_TYPES)
            allowed = ", ".join(_PARAMETER_TYPES)
            message = f"cannot use type {quote(written)}; allowed: {allowed}"
            self._error((*place, "type"), message, hint)
            return
        if fixed:
            self._unused((*place, "type"), f"the size in type {written!r}")
        for key in ("validation", "additional_constraints"):
            if entry.get(key) is not None:
                self._unused((*place, key), f"{key!r}")
        if name.startswith("__map_") or ".__map_" in name:
            self._unused(place, f"the parameter map {name!r}")
            return
        if type_ in ("", "none"):
            return  # `none` means no parameter at all
        default = self._document.find((*place, "default_value"))
        self.parameters.append(
            ParameterDeclaration(
                name=name,
                type=type_,
                default=None if default is None else _value(default.plain()),
                description=self._text((*place, "description")),
                read_only=self._data((*place, "read_only")) is True,
                at=self._document.at(place),
            )
        )

    # -- values

    def _data(self, place: Place) -> object:
        found = self._document.find(place)
        return None if found is None else found.data

    def _mapping(self, place: Place, what: str) -> Mapping[str, object]:
        data = self._data(place)
        if isinstance(data, Mapping) and (data or not place):
            return data
        self._error(place, f"cannot use {quote(data)} as {what}; it must be a mapping")
        return {}

    def _keys(self, place: Place) -> tuple[str, ...]:
        data = self._data(place)
        return tuple(data) if isinstance(data, Mapping) else ()

    def _items(self, place: Place) -> tuple[object, ...]:
        found = self._document.find(place)
        if found is None:
            return ()
        if isinstance(found.data, tuple):
            return found.data
        self._error(place, f"cannot use {quote(found.plain())} here; it must be a list")
        return ()

    def _text(self, place: Place, *, required: bool = False) -> str:
        found = self._document.find(place)
        if found is None:
            if required:
                self._error(place, f"cannot do without the key {place[-1]!r}")
            return ""
        if isinstance(found.data, str) and (found.data or not required):
            return found.data
        self._error(place, f"cannot use {quote(found.plain())} here; it must be a string")
        return ""

    def _word(self, place: Place, allowed: list[str]) -> str:
        data = self._data(place)
        if isinstance(data, str) and data in allowed:
            return data
        message = f"cannot use {place[-1]} {quote(data)}; allowed: {', '.join(allowed)}"
        self._error(place, message, did_you_mean(str(data), allowed))
        return ""

    def _number(self, place: Place) -> int:
        data = self._data(place)
        if isinstance(data, int) and not isinstance(data, bool):
            return data
        self._error(place, f"cannot use {place[-1]} {quote(data)}; it must be an integer")
        return 0

    # -- findings

    def _unknown(self, place: Place, entry: Iterable[str], known: Iterable[str]) -> None:
        words = list(known)
        for key in entry:
            if key not in words:
                at = self._document.key_at((*place, key))
                message = f"cannot use the key {key!r}: NoDL {NODL_VERSION} has none; it is ignored"
                self.found.append(
                    warning("nodl.unknown-key", at, message, did_you_mean(key, words))
                )

    def _unused(self, place: Place, what: str) -> None:
        at = self._document.at(place)
        self.found.append(
            warning(
                "nodl.unchecked", at, f"cannot check {what}; parameters are checked by type only"
            )
        )

    def _error(self, place: Place, message: str, hint: str = "") -> None:
        self.found.append(error("nodl.invalid", self._document.at(place), message, hint))


def _value(plain: object) -> ParameterValue | None:
    """Return a default as a parameter value; None for what no parameter can hold."""
    if isinstance(plain, (bool, int, float, str)):
        return plain
    if isinstance(plain, list) and all(isinstance(each, (bool, int, float, str)) for each in plain):
        return tuple(plain)
    return None


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
