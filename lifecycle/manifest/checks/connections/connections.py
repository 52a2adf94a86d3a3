"""Checks of who talks to whom: ends that have no other end.

Owns: check.unpublished, check.unheard, check.no-server. How severe they are is the manifest's
policy. Pure.
"""

from __future__ import annotations

from collections.abc import Iterator

from lifecycle.manifest.checks.implicit import implicit_names
from lifecycle.manifest.checks.system import Resolved, System
from lifecycle.manifest.diagnostics import Diagnostic, Severity
from lifecycle.manifest.model import EndpointKind
from lifecycle.manifest.schema.message_text import did_you_mean

_OTHER_END = {
    EndpointKind.SUBSCRIPTION: EndpointKind.PUBLISHER,
    EndpointKind.PUBLISHER: EndpointKind.SUBSCRIPTION,
    EndpointKind.SERVICE_CLIENT: EndpointKind.SERVICE_SERVER,
    EndpointKind.ACTION_CLIENT: EndpointKind.ACTION_SERVER,
}
"""Kinds that make no sense alone. A server that nobody calls is an offer."""

_RULES = {
    EndpointKind.SUBSCRIPTION: "check.unpublished",
    EndpointKind.PUBLISHER: "check.unheard",
    EndpointKind.SERVICE_CLIENT: "check.no-server",
    EndpointKind.ACTION_CLIENT: "check.no-server",
}


def check(system: System) -> Iterator[Diagnostic]:
    """Yield findings about endpoints that nothing in the manifest connects to."""
    implicit = implicit_names(system)
    for each in system.endpoints:
        kind = each.endpoint.kind
        other = _OTHER_END.get(kind)
        if other is None or system.named(other, each.name) or (other, each.name) in implicit:
            continue
        severity = _severity(system, kind)
        if severity is not None:
            yield _alone(system, each, other, severity)


def _severity(system: System, kind: EndpointKind) -> Severity | None:
    policy = system.manifest.policy
    severity = policy.unheard if kind is EndpointKind.PUBLISHER else policy.unpublished
    if severity is Severity.ERROR and system.is_open:
        return Severity.WARNING  # the other end may be one that the manifest does not declare
    return severity


def _alone(system: System, each: Resolved, other: EndpointKind, severity: Severity) -> Diagnostic:
    kind, policy = each.endpoint.kind, "unpublished"
    if kind is EndpointKind.PUBLISHER:
        message = f"cannot be heard on {each.name!r}: no node of this system subscribes to it"
        policy = "unheard"
    elif kind is EndpointKind.SUBSCRIPTION:
        message = f"cannot receive anything on {each.name!r}: no node of this system publishes it"
    else:
        message = f"cannot call {each.name!r}: no node of this system is its {other.noun}"
    hint = did_you_mean(each.name, system.names(other)) or (
        f"'policy: {{{policy}: ignore}}' accepts it"
    )
    return Diagnostic(rule=_RULES[kind], severity=severity, at=each.at, message=message, hint=hint)
