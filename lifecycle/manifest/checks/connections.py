"""Checks that endpoints have counterparts that match, and of `connections:` and their URLs.

QoS is judged by the rule of `lifecycle.manifest.qos`; types are looked up in the ament index.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator

import msgspec

from lifecycle.errors import did_you_mean
from lifecycle.manifest import installed_types
from lifecycle.manifest.checks.system import (
    DeclaredSystem,
    Resolved,
    implicit_names,
)
from lifecycle.manifest.diagnostics import Diagnostic, Position, error, warning
from lifecycle.manifest.model import (
    Authority,
    ConnectionDeclaration,
    DiscoveryMode,
    EndpointKind,
    EndpointPolicy,
    Node,
    RunKind,
)
from lifecycle.manifest.qos import Certainty, Incompatibility, incompatibilities
from lifecycle.network.connection_url import ConnectionUrlError, check_together
from lifecycle.network.nfe import may_be_same
from lifecycle.network.ports import DG, domain_base

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


_FLOW_NAME = re.compile(r"flow_[0-9]+\Z")


def check_foreign(system: DeclaredSystem, node: Node) -> Iterator[Diagnostic]:
    """Yield a finding about connections of a node that makes its participants itself."""
    supervised = system.manifest.data_layer.authority is Authority.SUPERVISOR
    if not node.connections or node.run.kind is RunKind.PYTHON or (supervised and node.managed):
        return  # of a managed one its ~/connect_to service is called, if it has one
    message = f"cannot connect {node.key!r}: its participants are its own code's to make"
    hint = "write it as 'run: {python: module:Class}'"
    if not supervised:
        hint += ", or use 'data_layer: {authority: supervisor}' if it has ~/connect_to"
    at = node.where(f"connections.{node.connections[0].name}")
    yield error("check.connection-foreign", at, message, hint)


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


def check_connection_names(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Yield findings about names of connections that something else has."""
    rule, mode = "check.connection-name", system.manifest.discovery.mode
    hidden: dict[str, tuple[Node, ConnectionDeclaration]] = {}
    declared = ((node, each) for node in system.manifest.nodes for each in node.connections)
    for node, connection in declared:
        reserved = ""
        if _FLOW_NAME.match(connection.name):
            reserved = "it names a participant that tells a flow apart"
        if connection.name == "data" and mode is DiscoveryMode.STATIC_ENDPOINTS:
            reserved = "in discovery mode static_endpoints it carries every topic"
        if reserved:
            message = f"cannot name a connection {connection.name!r}: {reserved}"
            yield error(rule, connection.at, message, "choose another name")
        namespace, _, base = node.full_name.rpartition("/")
        name = f"{namespace}/_{base}_{connection.name}"
        owner, other = hidden.setdefault(name, (node, connection))
        if other is not connection:
            message = (
                f"cannot name a connection of {node.key!r} {connection.name!r}: its hidden node "
                f"{name!r} would have the name of that of {other.name!r} of {owner.key!r} "
                f"({other.at.spelled})"
            )
            yield error(rule, connection.at, message, "choose another name")


def check_lossy(system: DeclaredSystem, node: Node) -> Iterator[Diagnostic]:
    """Judge data that must arrive against the connection that carries them."""
    for connection in node.connections:
        groups_only = all(url.transport.is_group for url in connection.urls)
        for kind, name in connection.map if groups_only else ():
            each = system.needs.of(node.key, kind, name)
            if each is not None and each.need.lossy is False:
                message = (
                    f"cannot carry {kind.noun} {name!r}, whose data are declared not lossy, by "
                    f"multicast alone, as connection {connection.name!r} does"
                )
                hint = "add 'tcpv4://' or 'udpv4://' to it, or remove 'lossy: false'"
                yield error("check.connection-flow", each.need.at, message, hint)


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
        nearest = installed_types.nearest_type(type_, system.prefixes)
        hint = f"did you mean {nearest!r}?" if nearest else ""
        if types is not None:
            message = f"cannot find type {type_!r}: package {package!r} has no such type"
            yield error("check.type-unknown", endpoint.at, message, hint)
        else:
            # Once per package: the answer is the same for all of its types.
            absent.add(package)
            message = f"cannot tell whether {type_!r} exists: {package!r} is not installed here"
            yield warning("check.type-not-installed", endpoint.at, message, hint)
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


class _Use(msgspec.Struct, frozen=True, kw_only=True):
    """One port that a URL opens."""

    host: str
    tcp: bool
    group: bool
    address: str
    port: int
    what: str
    at: Position


def check_connection_ports(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Yield findings about ports in URLs that something else has."""
    uses = list(_uses(system))
    yield from _port_collisions(uses)
    yield from _well_known(system, uses)


def _uses(system: DeclaredSystem) -> Iterator[_Use]:
    urls = (
        (node, connection, index, url)
        for node in system.manifest.nodes
        for connection in node.connections
        for index, url in enumerate(connection.urls)
    )
    for node, connection, index, url in urls:
        group = url.transport.is_group
        for attribute in ("port", "metatraffic_port", "output_port"):
            word = attribute.replace("_", " ")
            if (port := getattr(url, attribute)) is not None:
                yield _Use(
                    host=system.manifest.address_of(node.machine),
                    tcp=url.transport.is_tcp,
                    group=group and attribute == "port",
                    address="" if group or attribute == "output_port" else url.address,
                    port=port,
                    what=f"{word} of connection {connection.name!r} of {node.key!r}",
                    at=node.where(f"connections.{connection.name}.urls.{index}"),
                )


def _port_collisions(uses: list[_Use]) -> Iterator[Diagnostic]:
    seen: dict[tuple[str, bool, int], list[_Use]] = {}
    for use in uses:
        for other in seen.setdefault((use.host, use.tcp, use.port), []):
            if use.group and other.group:
                continue
            one, two = use.address or "0.0.0.0", other.address or "0.0.0.0"  # noqa: S104 - a name
            if may_be_same(one, two, same_machine=True):
                protocol = "TCP" if use.tcp else "UDP"
                message = (
                    f"cannot give {protocol} port {use.port} to the {use.what}: it is the "
                    f"{other.what} ({other.at.spelled})"
                )
                yield error("check.connection-ports", use.at, message, "choose another port")
                break
        seen[use.host, use.tcp, use.port].append(use)


def _well_known(system: DeclaredSystem, uses: list[_Use]) -> Iterator[Diagnostic]:
    """Judge ports that participants of the system's own domain take by themselves."""
    discovery = system.manifest.discovery
    domain = discovery.domain_id or 0
    if discovery.mode is not DiscoveryMode.DYNAMIC or not discovery.transport.by_udp:
        return
    base = domain_base(domain)
    for use in uses:
        if not use.tcp and use.port in range(base, base + DG):
            message = (
                f"cannot give UDP port {use.port} to the {use.what}: domain {domain} has it for "
                "its participants"
            )
            hint = f"choose a port outside of {base}–{min(base + DG - 1, 65535)}"
            yield error("check.connection-ports", use.at, message, hint)


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
    check_connection_names,
    check_connection_ports,
)
OF_A_NODE = (check_mapped, check_foreign, check_lossy, check_urls)
