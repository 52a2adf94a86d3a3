"""Checks that endpoints have counterparts that match, and of `connections:` and their URLs.

QoS is judged by the rule of `lifecycle.manifest.qos`; types are looked up in the ament index.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator

from lifecycle.errors import did_you_mean
from lifecycle.manifest import installed_types
from lifecycle.manifest.checks.system import (
    DeclaredSystem,
    Resolved,
    implicit_names,
)
from lifecycle.manifest.diagnostics import Diagnostic, Position, error, warning
from lifecycle.manifest.model import (
    DiscoveryMode,
    EndpointKind,
    EndpointPolicy,
    Node,
    RunKind,
)
from lifecycle.manifest.qos import Certainty, Incompatibility, incompatibilities
from lifecycle.network.connection_url import ConnectionUrlError, check_together

_RULES = {
    EndpointKind.SUBSCRIPTION: "check.unpublished",
    EndpointKind.PUBLISHER: "check.unheard",
    EndpointKind.SERVICE_CLIENT: "check.no-server",
    EndpointKind.ACTION_CLIENT: "check.no-server",
}
"""Kinds that make no sense alone. A server without a client is an offer."""


def check_counterparts(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Yield findings about endpoints that nothing in the manifest connects to."""
    implicit, policy = implicit_names(system), system.manifest.policy
    unnamed = {endpoint.kind for _, endpoint, _ in system.unresolved}
    for each in system.endpoints:
        kind = each.endpoint.kind
        other = kind.other_end
        if kind not in _RULES or system.named(other, each.name) or (other, each.name) in implicit:
            continue
        key, wanted = "unpublished", policy.unpublished
        if kind is EndpointKind.PUBLISHER:
            key, wanted = "unheard", policy.unheard
            message = f"cannot be heard on {each.name!r}: no node of this system subscribes to it"
        elif kind is EndpointKind.SUBSCRIPTION:
            why = "no node of this system publishes it"
            message = f"cannot receive anything on {each.name!r}: {why}"
        else:
            message = f"cannot call {each.name!r}: no node of this system is its {other.noun}"
        if wanted == "ignore" or other in unnamed:  # it may be the one with the wrong name
            continue
        # Of an open system the other end may be one that the manifest does not declare.
        make = warning if wanted == "warning" or system.is_open else error
        accept = f"'policy: {{{key}: ignore}}' accepts it"
        hint = did_you_mean(each.name, system.names(other)) or accept
        yield make(_RULES[kind], each.at, message, hint)


def check_mapped(_system: DeclaredSystem, node: Node) -> Iterator[Diagnostic]:
    """Judge what the connections of a node carry."""
    rule = "check.connection-endpoint"
    declared = {(each.kind, each.name) for each in node.interface.endpoints}
    first: dict[tuple[EndpointKind, str], tuple[str, Position]] = {}
    for connection in node.connections:
        counts: dict[EndpointKind, int] = {}
        for kind, name in connection.map:
            index = counts[kind] = counts.get(kind, -1) + 1
            place = f"connections.{connection.name}.map"
            at = node.positions.get(f"{place}.{kind.value}.{index}", node.where(place))
            what = f"cannot map {kind.noun} {name!r} onto {connection.name!r}"
            other, there = first.setdefault((kind, name), (connection.name, at))
            if (kind, name) not in declared:
                known = sorted(each for of, each in declared if of is kind)
                message = f"{what}: {node.key!r} declares no such endpoint"
                hint = did_you_mean(name, known) or f"declared: {', '.join(known) or 'none'}"
                opened = node.endpoints is EndpointPolicy.OPEN
                yield (warning if opened else error)(rule, at, message, hint)
            elif there is not at:
                message = f"{what}: it is mapped onto {other!r} ({there.spelled})"
                hint = "one connection may have several URLs: put them together"
                yield error(rule, at, message, hint)


def check_connection_names(system: DeclaredSystem, node: Node) -> Iterator[Diagnostic]:
    """Yield findings about names of connections that participants of the planner have."""
    taken = "flow_[0-9]+"
    if system.manifest.discovery.mode is DiscoveryMode.STATIC_ENDPOINTS:
        taken = f"{taken}|data"  # which carries every topic
    for connection in node.connections:
        if re.fullmatch(taken, connection.name):
            message = f"cannot name a connection {connection.name!r}: the planner has one"
            yield error("check.connection-name", connection.at, message, "choose another name")


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
    kinds = (each.offered, each.requested)
    return each.policy == "liveliness" and _MANUAL not in kinds and "BEST_AVAILABLE" not in kinds


def _remedy(each: Incompatibility) -> str:
    if each.requested.endswith(" ns"):
        here = (
            "or request none here"
            if each.offered == "infinite"
            else (f"or request at least {each.offered} here")
        )
        return f"offer at most {each.requested} there, {here}"
    return f"offer {each.requested} there, or request {each.offered} here"


def check_types(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Yield findings about types that do not exist, and differ at the ends of one name."""
    types_of = functools.cache(lambda package: installed_types.types_of(package, system.prefixes))
    absent: set[str] = set()
    endpoints = (each for node in system.manifest.nodes for each in node.interface.endpoints)
    for endpoint in endpoints:
        type_ = endpoint.type
        package, _, name = type_.partition("/")
        types = types_of(package)
        if package in absent or (types is not None and name in types):
            continue
        if types is not None:
            hint = did_you_mean(name, types)
            message = f"cannot find type {type_!r}: package {package!r} has no such type"
            yield error("check.type-unknown", endpoint.at, message, hint)
        else:
            # Once per package: the answer is the same for all of its types.
            absent.add(package)
            message = f"cannot tell whether {type_!r} exists: {package!r} is not installed here"
            yield warning("check.type-not-installed", endpoint.at, message)
    first: dict[tuple[str, str], Resolved] = {}
    for each in system.endpoints:
        family = each.endpoint.kind.meets_in
        other = first.setdefault((family, each.name), each)
        if each.endpoint.type != other.endpoint.type:
            message = (
                f"cannot use type {each.endpoint.type!r} for {family} {each.name!r}: "
                f"{other} uses {other.endpoint.type!r}"
            )
            yield error("check.type-mismatch", each.at, message, "use one type at all ends")


def check_connection_ports(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Yield findings about ports that two URLs of one host open."""
    first: dict[tuple[str, bool, str, int], Position] = {}
    urls = (
        (node, url, node.where(f"connections.{connection.name}.urls.{index}"))
        for node in system.manifest.nodes
        for connection in node.connections
        for index, url in enumerate(connection.urls)
    )
    for node, url, at in urls:
        ports = [url.metatraffic_port, url.output_port]
        ports += [] if url.transport.is_group else [url.port]  # which many may listen to
        for port in filter(None, ports):
            host = system.manifest.address_of(node.machine)
            key = (host, url.transport.is_tcp, url.address, port)
            other = first.setdefault(key, at)
            if other is not at:
                message = f"cannot open port {port} twice on a host: {other.spelled} does, too"
                yield error("check.connection-ports", at, message, "choose another port")


def check_urls(_system: DeclaredSystem, node: Node) -> Iterator[Diagnostic]:
    """Judge URLs that one participant cannot have together."""
    for connection in node.connections:
        try:
            check_together(connection.urls)
        except ConnectionUrlError as refusal:  # noqa: PERF203 - each is reported
            at = node.where(f"connections.{connection.name}")
            yield error("check.connection-urls", at, refusal.message, refusal.hint)


CHECKS = (
    check_types,
    check_qos,
    check_counterparts,
    check_connection_ports,
)
OF_A_NODE = (check_mapped, check_connection_names, check_urls)
