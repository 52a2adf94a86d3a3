"""Checks of types: they exist, and all ends of one name agree on one.

Owns: check.type-unknown, check.type-not-installed, check.type-mismatch. Reads the ament index.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from lifecycle.manifest.checks.system import Resolved, System
from lifecycle.manifest.diagnostics import Diagnostic
from lifecycle.manifest.model import EndpointKind
from lifecycle.manifest.types.interface_types import TypeLookup, TypeStatus, look_up
from lifecycle.manifest.yaml.document import error, warning

FAMILIES = {
    "topic": (EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION),
    "service": (EndpointKind.SERVICE_SERVER, EndpointKind.SERVICE_CLIENT),
    "action": (EndpointKind.ACTION_SERVER, EndpointKind.ACTION_CLIENT),
}
"""The kinds that meet under one name; topics, services and actions do not see each other."""


def check(system: System, prefixes: Sequence[Path]) -> Iterator[Diagnostic]:
    """Yield findings about types."""
    yield from _missing(system, prefixes)
    for family, kinds in FAMILIES.items():
        by_name: dict[str, list[Resolved]] = {}
        for each in system.endpoints:
            if each.endpoint.kind in kinds:
                by_name.setdefault(each.name, []).append(each)
        for name, ends in by_name.items():
            yield from _mismatches(family, name, ends)


def _missing(system: System, prefixes: Sequence[Path]) -> Iterator[Diagnostic]:
    answers: dict[str, TypeLookup] = {}
    absent: set[str] = set()
    for node in system.manifest.nodes:
        for endpoint in node.interface.endpoints:
            type_ = endpoint.type
            if type_ not in answers:
                answers[type_] = look_up(type_, prefixes)
            answer, package = answers[type_], type_.partition("/")[0]
            hint = f"did you mean {answer.nearest!r}?" if answer.nearest else ""
            if answer.status is TypeStatus.NO_SUCH_TYPE:
                message = f"cannot find type {type_!r}: package {package!r} has no such type"
                yield error("check.type-unknown", endpoint.at, message, hint)
            elif answer.status is TypeStatus.NOT_INSTALLED and package not in absent:
                # Once per package: the answer is the same for all of its types.
                absent.add(package)
                message = f"cannot tell whether {type_!r} exists: {package!r} is not installed here"
                yield warning("check.type-not-installed", endpoint.at, message, hint)


def _mismatches(family: str, name: str, ends: list[Resolved]) -> Iterator[Diagnostic]:
    first = ends[0]
    for each in ends[1:]:
        if each.endpoint.type != first.endpoint.type:
            message = (
                f"cannot use type {each.endpoint.type!r} for {family} {name!r}: "
                f"{first} uses {first.endpoint.type!r}"
            )
            yield error("check.type-mismatch", each.at, message, "use one type at all ends")
