"""Checks that endpoints match: QoS compatibility of publishers and subscriptions, and types.

Owns: check.qos-incompatible, check.qos-doubtful, by the rule of `lifecycle.manifest.qos`;
check.type-unknown, check.type-not-installed, check.type-mismatch. Reads the ament index.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from lifecycle.manifest.checks.system import DeclaredSystem, Resolved
from lifecycle.manifest.diagnostics import Diagnostic
from lifecycle.manifest.installed_types import TypeLookup, TypeStatus, look_up
from lifecycle.manifest.model import EndpointKind, RunKind
from lifecycle.manifest.qos import Certainty, Incompatibility, incompatibilities
from lifecycle.manifest.yaml.document import error, warning

_MANUAL = "MANUAL_BY_TOPIC"


def check_qos(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Yield findings about every pair of endpoints that the resolved names bring together."""
    for name in system.names(EndpointKind.SUBSCRIPTION):
        publishers = system.named(EndpointKind.PUBLISHER, name)
        for requesting in system.named(EndpointKind.SUBSCRIPTION, name):
            for offering in publishers:
                yield from _judge(offering, requesting, "", at=requesting)
    for name in system.names(EndpointKind.SERVICE_CLIENT):
        servers = system.named(EndpointKind.SERVICE_SERVER, name)
        for client in system.named(EndpointKind.SERVICE_CLIENT, name):
            for server in servers:
                # One profile holds for both directions of a service's end.
                yield from _judge(client, server, " for requests", at=client)
                yield from _judge(server, client, " for replies", at=client)


def _judge(
    offering: Resolved, requesting: Resolved, what: str, *, at: Resolved
) -> Iterator[Diagnostic]:
    offered, requested = offering.endpoint.qos, requesting.endpoint.qos
    if offered is None or requested is None or offering.endpoint.type != requesting.endpoint.type:
        return  # types that differ are reported by `check_types`
    other = requesting if at is offering else offering
    doubtful = []
    unknown = _left_open(offering) | _left_open(requesting)
    for each in incompatibilities(offered, requested):
        if each.policy in unknown:
            continue
        values = f"{each.policy} is offered {each.offered} and requested {each.requested}{what}"
        if each.severity is Certainty.CERTAIN:
            message = f"cannot match {other} on {at.name!r}: {values}"
            yield error("check.qos-incompatible", at.at, message, _remedy(each))
        elif not _is_settled(each):
            doubtful.append(values)
    if doubtful:
        message = f"cannot tell whether this matches {other} on {at.name!r}: {', '.join(doubtful)}"
        hint = "write the values at both ends"
        yield warning("check.qos-doubtful", at.at, message, hint)


def _left_open(end: Resolved) -> set[str]:
    """Return the policies that only a node's own code knows: it is not ours, they are not written.

    Whether they fit is judged when it runs (graph.qos-incompatible).
    """
    if end.node.run.kind is RunKind.PYTHON:
        return set()
    return {policy.removesuffix("_ns") for policy in end.endpoint.qos_defaults}


def _is_settled(each: Incompatibility) -> bool:
    """Whether an undeclared liveliness is no reason to doubt.

    Every preset of rmw but one has SYSTEM_DEFAULT there, and DDS's default is AUTOMATIC (DDS 1.4
    §2.2.3), which satisfies everything but a request for MANUAL_BY_TOPIC.
    """
    told = (each.offered, each.requested)
    return each.policy == "liveliness" and _MANUAL not in told and "BEST_AVAILABLE" not in told


def _remedy(each: Incompatibility) -> str:
    if each.requested.endswith(" ns"):
        here = (
            "or request none here"
            if each.offered == "infinite"
            else (f"or request at least {each.offered} here")
        )
        return f"offer at most {each.requested} there, {here}"
    return f"offer {each.requested} there, or request {each.offered} here"


FAMILIES = {
    "topic": (EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION),
    "service": (EndpointKind.SERVICE_SERVER, EndpointKind.SERVICE_CLIENT),
    "action": (EndpointKind.ACTION_SERVER, EndpointKind.ACTION_CLIENT),
}
"""The kinds that meet under one name; topics, services and actions do not see each other."""


def check_types(system: DeclaredSystem, prefixes: Sequence[Path]) -> Iterator[Diagnostic]:
    """Yield findings about types."""
    yield from _missing(system, prefixes)
    for family, kinds in FAMILIES.items():
        by_name: dict[str, list[Resolved]] = {}
        for each in system.endpoints:
            if each.endpoint.kind in kinds:
                by_name.setdefault(each.name, []).append(each)
        for name, ends in by_name.items():
            yield from _mismatches(family, name, ends)


def _missing(system: DeclaredSystem, prefixes: Sequence[Path]) -> Iterator[Diagnostic]:
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
