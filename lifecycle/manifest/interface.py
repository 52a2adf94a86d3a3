"""Validated interfaces → endpoints and parameter declarations, of manifests and NoDL documents.

Owns: `build_inline`: what a QoS profile is with presets and defaults, declared defaults of
parameters in their types; values that are given to parameters, flat. Pure.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import msgspec

from lifecycle.codec import Octet
from lifecycle.manifest import written
from lifecycle.manifest.diagnostics import Diagnostic, Position
from lifecycle.manifest.model import (
    Endpoint,
    EndpointKind,
    Interface,
    ParameterDeclaration,
    ParameterValue,
)
from lifecycle.manifest.qos import (
    POLICIES,
    PRESETS,
    History,
    QosProfile,
    not_written,
)
from lifecycle.manifest.written import build, read_part
from lifecycle.manifest.yaml.document import Document, error, note
from lifecycle.manifest.yaml.yaml_parser import YAML_1_1_BOOLEANS, has_leading_zero, quote

Findings = list[Diagnostic]
"""Findings in the order of detection; every builder appends and continues."""

_DEFAULT_PRESET = {
    EndpointKind.PUBLISHER: "default",
    EndpointKind.SUBSCRIPTION: "default",
    EndpointKind.SERVICE_SERVER: "services_default",
    EndpointKind.SERVICE_CLIENT: "services_default",
}


def build_inline(interface: Document, found: Findings) -> Interface:
    """Build an interface that is written out.

    Args:
        interface: a mapping that fits the schema's `interface`.
        found: findings are appended here.
    """
    endpoints = []
    for kind in EndpointKind:
        first: dict[str, Document] = {}
        for each in interface.items(kind.value):
            other = first.setdefault(each.text("name"), each)
            if other is each:
                endpoints.append(_endpoint(kind, each, found))
            else:
                message = f"cannot declare {quote(each.text('name'))} twice among {kind.value}"
                hint = f"the first stands at {other.at().spelled}"
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
    written_qos = part.get("qos")
    return Endpoint(
        kind=kind,
        name=part.text("name"),
        type=part.text("type"),
        qos=None if preset is None else _qos(written_qos, PRESETS[preset], found),
        qos_defaults=() if preset is None else _defaults(written_qos),
        at=part.at(),
    )


def _qos(part: Document | None, default: QosProfile, found: Findings) -> QosProfile:
    """Lay what is written over a preset, or over the default of the endpoint's kind."""
    if part is None:
        return default
    policies = part.plain()
    if isinstance(policies, str):
        return PRESETS[policies]
    preset = policies.pop("preset", None)
    plain = {**msgspec.to_builtins(PRESETS[preset] if preset else default), **policies}
    # rmw and NoDL alike: a duration of zero is none (RMW_DURATION_UNSPECIFIED).
    plain |= {name: each or None for name, each in plain.items() if name.endswith("_ns")}
    if plain["history"] == History.KEEP_ALL.value:
        plain["depth"] = 0  # rmw ignores it there
    profile = msgspec.convert(plain, QosProfile, strict=False)
    if profile.history is History.KEEP_LAST and profile.depth == 0:
        message = "cannot use depth 0 with KEEP_LAST: it would keep nothing; set depth >= 1"
        found.append(error("manifest.qos", part.at(("depth",)), message))
    return profile


def _defaults(qos: Document | None) -> tuple[str, ...]:
    """Return the policies that are not written; naming a preset writes all of it."""
    if qos is None:
        return POLICIES
    policies = qos.plain()
    return () if isinstance(policies, str) or "preset" in policies else not_written(policies)


def _declaration(name: str, part: Document, found: Findings) -> ParameterDeclaration:
    declared = read_part(part, written.Parameter)
    default = part.get("default_value")
    return build(
        ParameterDeclaration,
        declared,
        name=name,
        default=None if default is None else _default(default, declared.type, found),
        at=part.key_at(),
    )


_TYPES: Mapping[str, Any] = {
    "bool": bool,
    "int": int,
    "double": float,
    "string": str,
    "bool_array": tuple[bool, ...],
    "int_array": tuple[int, ...],
    "double_array": tuple[float, ...],
    "string_array": tuple[str, ...],
    "byte_array": tuple[Octet, ...],
}


def _default(part: Document, type_: str, found: Findings) -> ParameterValue | None:
    """Return a declared default in its declared type; None after reporting that it does not fit."""
    try:
        value: ParameterValue = msgspec.convert(part.plain(), _TYPES[type_])
    except msgspec.ValidationError:
        shown = quote(part.plain())
        message = f"cannot use {shown} as default of a parameter of type {type_}"
        found.append(error("manifest.parameter-default", part.at(), message))
        return None
    return value


def build_parameters(node: Document, found: Findings) -> dict[str, tuple[ParameterValue, Position]]:
    """Flatten `parameters:` of a node, group or document into dotted names, as rcl's files do."""
    return flat_parameters(node.entries("parameters"), found)


def flat_parameters(
    entries: Iterable[tuple[str, Document]], found: Findings
) -> dict[str, tuple[ParameterValue, Position]]:
    """Return values by dotted name, and where each is written."""
    flat: dict[str, tuple[ParameterValue, Position]] = {}
    pending = list(reversed(list(entries)))
    while pending:
        name, part = pending.pop()
        if isinstance(part.root.data, dict):
            inner = [(f"{name}.{key}", each) for key, each in part.entries()]
            pending.extend(reversed(inner))
            continue
        if name in flat:
            message = f"cannot set the parameter {name!r} twice"
            first = flat[name][1]
            hint = f"the first value stands at {first.spelled}"
            found.append(error("manifest.duplicate-parameter", part.at(), message, hint))
            continue
        value = parameter_value(name, part, found)
        if value is not None:
            flat[name] = (value, part.key_at())
    return flat


def parameter_value(name: str, part: Document, found: Findings) -> ParameterValue | None:
    """Return the value of a parameter or argument; None after reporting that it cannot be one."""
    if isinstance(part.root.data, tuple):
        return _scalar_tuple(part, found)
    text = part.root.text
    if not part.root.quoted and len(text) > 1 and text in YAML_1_1_BOOLEANS:
        message = f"cannot tell whether {text} is meant as a boolean; it is read as a string"
        hint = f'write {name}: true or false, or {name}: "{text}"'
        found.append(note("manifest.yaml-1.1-boolean", part.at(), message, hint))
    if not part.root.quoted and has_leading_zero(text):
        message = f"cannot tell which number {text} is meant as; it is read as a string"
        hint = f'write {name}: {text.lstrip("+0") or "0"}, or {name}: "{text}"'
        found.append(note("manifest.leading-zero", part.at(), message, hint))
    return part.scalar


def _scalar_tuple(part: Document, found: Findings) -> tuple[bool | int | float | str, ...] | None:
    """Return a ROS array; None after reporting that its items differ in type."""
    values = part.plain()
    types = {type(each).__name__: each for each in values}
    if len(types) == 1 or not values:
        return tuple(values)
    names = {"str": "string", "float": "double"}
    spelled = " and ".join(f"{names.get(name, name)} {quote(each)}" for name, each in types.items())
    message = f"cannot mix {spelled} in one array; a ROS array holds one type"
    hint = "write the integers as 1.0" if set(types) == {"int", "float"} else ""
    found.append(error("manifest.parameter-array", part.at(), message, hint))
    return None
