"""Interfaces → endpoints and parameter declarations: written out, or in NoDL v2 documents.

Owns: what a QoS profile is with presets and defaults, declared defaults of parameters in their
types; references (`local://relative/path`, `nodl://package/name`) with the documents they include,
and what of NoDL differs from an inline interface: types without their kind, and those of
generate_parameter_library, of which sizes and validations are not checked. The format is
nodl.schema.yaml of ros-tooling/nodl 2.0 and parameter.schema.yaml. What it does not know is a
warning; what cannot be an interface is an error.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import msgspec
from msgspec.structs import replace

from lifecycle.codec import Octet
from lifecycle.errors import did_you_mean, nearest
from lifecycle.manifest.diagnostics import (
    Findings,
    ManifestError,
    Position,
    Severity,
    error,
    warning,
)
from lifecycle.manifest.installed_types import find_resource, list_resources, search_prefixes
from lifecycle.manifest.model import (
    Endpoint,
    EndpointKind,
    Interface,
    Parameter,
    ParameterDeclaration,
    ParameterValue,
)
from lifecycle.manifest.parameter_values import SCALARS
from lifecycle.manifest.qos import (
    POLICIES,
    PRESETS,
    History,
    QosProfile,
    not_written,
)
from lifecycle.manifest.schema import validate
from lifecycle.manifest.written import build, read_part
from lifecycle.manifest.yaml.document import (
    Document,
    Value,
    quote,
)
from lifecycle.manifest.yaml.source import read_document

_DEFAULT_PRESET = {
    EndpointKind.PUBLISHER: "default",
    EndpointKind.SUBSCRIPTION: "default",
    EndpointKind.SERVICE_SERVER: "services_default",
    EndpointKind.SERVICE_CLIENT: "services_default",
}


def build_inline(interface: Document, found: Findings) -> Interface:
    """Build an interface that is written out: a mapping that fits the schema's `Interface`."""
    endpoints = []
    for kind in EndpointKind:
        first: dict[str, Document] = {}
        for each in interface.items(kind.value):
            other = first.setdefault(each.text("name"), each)
            if other is each:
                endpoints.append(_endpoint(kind, each, found))
            else:
                message = f"cannot declare {quote(each.text('name'))} twice among {kind.value}"
                hint = f"the first is at {other.at().spelled}"
                at = each.at(("name",))
                found.append(error("manifest.duplicate-name", at, message, hint))
    parameters = (_declaration(name, each, found) for name, each in interface.entries("parameters"))
    return Interface(
        endpoints=tuple(endpoints),
        parameters=tuple(parameters),
        has_all_parameters="parameters" in interface,
    )


def _endpoint(kind: EndpointKind, part: Document, found: Findings) -> Endpoint:
    preset = _DEFAULT_PRESET.get(kind)
    qos, left_open = None, tuple[str, ...]()
    if preset is not None:
        qos, left_open = _qos(part.get("qos"), PRESETS[preset], found)
    return Endpoint(
        kind=kind,
        name=part.text("name"),
        type=part.text("type"),
        qos=qos,
        qos_defaults=left_open,
        at=part.at(),
    )


def _qos(
    part: Document | None, default: QosProfile, found: Findings
) -> tuple[QosProfile, tuple[str, ...]]:
    """Lay what is written over a preset, or over the default of the endpoint's kind.

    Returns:
        The profile, and its policies that are not written; naming a preset writes all of it.
    """
    if part is None:
        return default, POLICIES
    policies = part.plain()
    if isinstance(policies, str):
        return PRESETS[policies], ()
    preset = policies.pop("preset", None)
    left_open = () if preset else not_written(policies)
    plain = {**msgspec.to_builtins(PRESETS[preset] if preset else default), **policies}
    # rmw and NoDL alike: a duration of zero is none (RMW_DURATION_UNSPECIFIED).
    plain |= {name: each or None for name, each in plain.items() if name.endswith("_ns")}
    if plain["history"] == History.KEEP_ALL.value:
        plain["depth"] = 0  # rmw ignores it there
    profile = msgspec.convert(plain, QosProfile, strict=False)
    if profile.history is History.KEEP_LAST and profile.depth == 0:
        message = "cannot use depth 0 with KEEP_LAST: it would keep nothing; set depth >= 1"
        found.append(error("manifest.qos", part.at(("depth",)), message))
    return profile, left_open


_ONE = {**{name: type_ for type_, name in SCALARS.items()}, "byte": Octet}
"""Types of one value of a parameter, by the names of types without `_array`."""


def _declaration(name: str, part: Document, found: Findings) -> ParameterDeclaration:
    declared = read_part(part, Parameter)
    default: ParameterValue | None = None
    if (value := part.get("default_value")) is not None:
        try:
            type_: Any = _ONE[declared.type.removesuffix("_array")]
            is_array = declared.type.endswith("_array")
            default = msgspec.convert(value.plain(), tuple[type_, ...] if is_array else type_)
        except msgspec.ValidationError:
            what = f"{quote(value.plain())} as default of a parameter of type {declared.type}"
            found.append(error("manifest.parameter-default", value.at(), f"cannot use {what}"))
    return build(ParameterDeclaration, declared, name=name, default=default, at=part.key_at())


NODL_VERSION = 2

_NOT_OURS = ("nodl_version", "description", "codegen", "include")
_UNCHECKED = ("additional_constraints", "validation")
_PARAMETER_KEYS = ("type", "default_value", "description", "read_only")
_FIXED_SIZE = re.compile(r"(string|int_array|double_array|string_array)_fixed_[1-9][0-9]*")


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
    environment: Mapping[str, str],
    found: Findings,
) -> Interface:
    """Read the interface that a reference names, with everything it includes, as far as it can be.

    Args:
        reference: `local://PATH`, relative to `base`, or `nodl://PACKAGE/NAME` in the ament index.
        base: directory of the document that holds the reference.
        at: where that document holds it.
        environment: for AMENT_PREFIX_PATH.
        found: where findings go.
    """
    reading = _NodlReading(search_prefixes(environment), found)
    try:
        reading.follow(reference, Path(base), at)
    except OSError as problem:  # a name that is too long, a folder that is not ours to search
        message = f"cannot follow {quote(reference)}: {problem.strerror}"
        found.append(error("nodl.not-found", at, message))
    return Interface(
        endpoints=tuple(reading.endpoints),
        parameters=tuple(reading.parameters),
        has_all_parameters=True,
    )


class _NodlReading:
    """One walk over a document and its includes; collects entities and findings."""

    def __init__(self, prefixes: tuple[Path, ...], found: Findings) -> None:
        self._prefixes = prefixes
        self._read: set[Path] = set()
        self.endpoints: list[Endpoint] = []
        self.parameters: list[ParameterDeclaration] = []
        self.found = found

    def follow(self, reference: str, base: Path, at: Position) -> None:
        """Read one reference with what it includes; each document counts once."""
        path = self._locate(reference, base, at)
        if path is None or (identity := path.resolve()) in self._read:
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
        interface = self._interface(document)
        self.endpoints += interface.endpoints
        self.parameters += interface.parameters
        includes = document.get("include")
        if includes is not None and not isinstance(includes.root.data, tuple):
            self._error("invalid", includes.at(), "cannot include what is no list")
            return
        for each in document.items("include"):
            if ref := each.text("ref"):
                self.follow(ref, path.parent, each.at(("ref",)))
            else:
                where = each.at(("ref",))
                self._error("invalid", where, "cannot do without the key 'ref' in an include")

    def _interface(self, document: Document) -> Interface:
        """Return what a document declares, its includes left out; nothing after an error."""
        before = len(self.found)
        lists = [kind.value for kind in EndpointKind]
        entries = self._known(document, [*_NOT_OURS, "parameters", *lists])
        version = entries.get("nodl_version")
        if version is None:
            message = "cannot do without the key 'nodl_version'"
            self._error("invalid", document.at(), message, "add 'nodl_version: 2'")
        elif version.data != NODL_VERSION:
            message = f"cannot use nodl_version {quote(version.data)}; allowed: {NODL_VERSION}"
            self._error("invalid", document.at(("nodl_version",)), message)
        for key in _NOT_OURS:
            entries.pop(key, None)
        for kind in EndpointKind:
            if (each := entries.get(kind.value)) and isinstance(each.data, tuple):
                data = tuple(self._endpoint(kind, part) for part in document.items(kind.value))
                entries[kind.value] = replace(each, data=data)
        if (each := entries.get("parameters")) and isinstance(each.data, dict):
            declared = {
                name: self._parameter(name, part) for name, part in document.entries("parameters")
            }
            known = {name: value for name, value in declared.items() if value is not None}
            entries["parameters"] = replace(each, data=known)
        inline = replace(document, root=replace(document.root, data=entries))
        found = list(validate(inline, definition="Interface"))
        interface = Interface() if found else build_inline(inline, found)
        rules = {"manifest.duplicate-name": "nodl.duplicate"}
        self.found += [replace(each, rule=rules.get(each.rule, "nodl.invalid")) for each in found]
        failed = any(each.severity is Severity.ERROR for each in self.found[before:])
        return Interface() if failed else interface

    def _endpoint(self, kind: EndpointKind, part: Document) -> Value:
        """Return an endpoint as a manifest has it."""
        if not isinstance(part.root.data, dict):
            return part.root
        known = ("name", "type", "description", *(() if kind.is_action else ("qos",)))
        entries = self._known(part, known)
        if (type_ := entries.get("type")) and type_.text.count("/") == 1:
            word = "msg" if kind.is_topic else "action" if kind.is_action else "srv"
            entries["type"] = _text(type_, type_.text.replace("/", f"/{word}/"))
        if (qos := part.get("qos")) and isinstance(qos.root.data, dict) and "qos" in entries:
            entries["qos"] = replace(qos.root, data=self._known(qos, POLICIES))
        return replace(part.root, data=entries)

    def _parameter(self, name: str, part: Document) -> Value | None:
        """Return a declaration as a manifest has it; None for what declares no parameter."""
        if not isinstance(part.root.data, dict):
            return part.root
        entries = self._known(part, (*_PARAMETER_KEYS, *_UNCHECKED))
        type_ = entries.get("type")
        if "__map_" in name or (type_ and type_.text == "none"):
            return None
        if type_ and (fixed := _FIXED_SIZE.fullmatch(type_.text)):
            entries["type"] = _text(type_, fixed[1])
        for key in _UNCHECKED:
            entries.pop(key, None)
        return replace(part.root, data=entries)

    def _known(self, part: Document, words: Iterable[str]) -> dict[str, Value]:
        """Return the entries of a mapping that NoDL knows, and warn of the others."""
        known, found = list(words), {}
        for key, each in part.entries():
            if key in known:
                found[key] = each.root
                continue
            message = f"cannot use the key {key!r}: NoDL {NODL_VERSION} has none; it is ignored"
            hint = did_you_mean(key, known)
            self.found.append(warning("nodl.unknown-key", each.key_at(), message, hint))
        return found

    def _locate(self, reference: str, base: Path, at: Position) -> Path | None:
        scheme, _, body = reference.partition("://")
        package, _, name = body.partition("/")
        if scheme == "local" and body:
            path = base / body
            if os.path.exists(path):
                return path
            message = f"cannot find {reference!r}: there is no file {str(path)!r}"
            self._error("not-found", at, message, nearest_file(path))
        elif scheme != "nodl":
            message = f"cannot follow {reference!r}; write local://PATH or nodl://PACKAGE/NAME"
            self._error("reference", at, message)
        elif not package or not name or "/" in name:
            self._error("reference", at, f"cannot follow {reference!r}; write nodl://PACKAGE/NAME")
        elif found := find_resource(_RESOURCE, f"{package}__{name}", self._prefixes):
            return found
        else:
            known = list_resources(_RESOURCE, self._prefixes)
            hint = did_you_mean(reference, [f"nodl://{x.replace('__', '/', 1)}" for x in known])
            message = f"cannot find {reference!r} in the ament index"
            source = f"source the workspace that installs {package}"
            hint = hint or f"{source}, so that AMENT_PREFIX_PATH names it"
            self._error("not-found", at, message, hint)
        return None

    def _error(self, rule: str, at: Position, message: str, hint: str = "") -> None:
        self.found.append(error(f"nodl.{rule}", at, message, hint))


def nearest_file(path: Path) -> str:
    """Return a hint that names the file of the same kind with the nearest name in that folder."""
    stem, _, kind = path.name.partition(".")
    files = [each.name.partition(".") for each in path.parent.glob(f"*.{kind}")]
    stems = {each: f"{each}{dot}{rest}" for each, dot, rest in files if rest == kind}
    found = nearest(stem, sorted(stems))
    return f"did you mean {stems[found]!r}?" if found else ""
