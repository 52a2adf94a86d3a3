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
from lifecycle.manifest.diagnostics import Diagnostic, Position, Severity, error, warning
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
from lifecycle.network.ports import DG, domain_base, owner_of

_RULES = {
    EndpointKind.SUBSCRIPTION: "check.unpublished",
    EndpointKind.PUBLISHER: "check.unheard",
    EndpointKind.SERVICE_CLIENT: "check.no-server",
    EndpointKind.ACTION_CLIENT: "check.no-server",
}
"""Kinds that make no sense alone. A server without a client is an offer."""


def check_counterparts(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Yield findings about endpoints that nothing in the manifest connects to."""
    implicit = implicit_names(system)
    unnamed = {endpoint.kind for _, endpoint, _ in system.unresolved}
    for each in system.endpoints:
        kind = each.endpoint.kind
        other = kind.other_end
        if kind not in _RULES or system.named(other, each.name) or (other, each.name) in implicit:
            continue
        severity = _severity(system, kind)
        if severity is not None and other not in unnamed:  # it may be the one with the wrong name
            yield _alone(system, each, other, severity)


def _severity(system: DeclaredSystem, kind: EndpointKind) -> Severity | None:
    policy = system.manifest.policy
    wanted = policy.unheard if kind is EndpointKind.PUBLISHER else policy.unpublished
    if wanted == "error" and system.is_open:
        return Severity.WARNING  # the other end may be one that the manifest does not declare
    return None if wanted == "ignore" else Severity(wanted)


def _alone(
    system: DeclaredSystem, each: Resolved, other: EndpointKind, severity: Severity
) -> Diagnostic:
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


_FLOW_NAME = re.compile(r"flow_[0-9]+\Z")


def check_connections(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Yield findings about every declared connection, but for its URLs."""
    hidden: dict[str, tuple[Node, ConnectionDeclaration]] = {}
    for node in system.manifest.nodes:
        yield from _endpoints(node)
        if node.connections:
            yield from _foreign(system, node)
        for each in node.connections:
            yield from _name(system, node, each, hidden)
            yield from _lossy(node, each, system)


def _foreign(system: DeclaredSystem, node: Node) -> Iterator[Diagnostic]:
    if node.run.kind is RunKind.PYTHON:
        return
    at = node.where(f"connections.{node.connections[0].name}")
    supervised = system.manifest.data_layer.authority is Authority.SUPERVISOR
    if supervised and node.managed:
        return  # its ~/connect_to service is called, if it has one
    message = f"cannot connect {node.key!r}: its participants are its own code's to make"
    hint = "write it as 'run: {python: module:Class}'" + (
        ""
        if supervised
        else ", or use 'data_layer: {authority: supervisor}' if it has ~/connect_to"
    )
    yield error("check.connection-foreign", at, message, hint)


def _endpoints(node: Node) -> Iterator[Diagnostic]:
    """Judge what the connections of a node carry."""
    declared = {(each.kind, each.name) for each in node.interface.endpoints}
    first: dict[tuple[EndpointKind, str], tuple[str, Position]] = {}
    for connection in node.connections:
        counts: dict[EndpointKind, int] = {}
        for kind, name in connection.map:
            index = counts.get(kind, 0)
            counts[kind] = index + 1
            place = f"connections.{connection.name}.map"
            at = node.where(f"{place}.{kind.value}.{index}")
            if at is node.at:
                at = node.where(place)
            if (kind, name) not in declared:
                known = [each for other, each in declared if other is kind]
                message = (
                    f"cannot map {kind.noun} {name!r} onto {connection.name!r}: {node.key!r} "
                    "declares no such endpoint"
                )
                hint = did_you_mean(name, known)
                if not hint:
                    hint = f"declared: {', '.join(sorted(known)) or 'none'}"
                opened = node.endpoints is EndpointPolicy.OPEN
                yield (warning if opened else error)("check.connection-endpoint", at, message, hint)
                continue
            other, there = first.setdefault((kind, name), (connection.name, at))
            if there is not at:
                message = (
                    f"cannot map {kind.noun} {name!r} onto {connection.name!r}: it is mapped "
                    f"onto {other!r} ({there.spelled})"
                )
                hint = "one connection may have several URLs: put them together"
                yield error("check.connection-endpoint", at, message, hint)


def _name(
    system: DeclaredSystem,
    node: Node,
    connection: ConnectionDeclaration,
    hidden: dict[str, tuple[Node, ConnectionDeclaration]],
) -> Iterator[Diagnostic]:
    reserved = ""
    if _FLOW_NAME.match(connection.name):
        reserved = "it names a participant that tells a flow apart"
    mode = system.manifest.discovery.mode
    if connection.name == "data" and mode is DiscoveryMode.STATIC_ENDPOINTS:
        reserved = "in discovery mode static_endpoints it carries every topic"
    if reserved:
        message = f"cannot name a connection {connection.name!r}: {reserved}"
        yield error("check.connection-name", connection.at, message, "choose another name")
    namespace, _, base = node.full_name.rpartition("/")
    name = f"{namespace}/_{base}_{connection.name}"
    owner, other = hidden.setdefault(name, (node, connection))
    if other is not connection:
        message = (
            f"cannot name a connection of {node.key!r} {connection.name!r}: its hidden node "
            f"{name!r} would have the name of that of {other.name!r} of {owner.key!r} "
            f"({other.at.spelled})"
        )
        yield error("check.connection-name", connection.at, message, "choose another name")


def _lossy(
    node: Node, connection: ConnectionDeclaration, system: DeclaredSystem
) -> Iterator[Diagnostic]:
    """Judge data that must arrive against the connection that carries them."""
    if not all(url.transport.is_group for url in connection.urls):
        return
    for kind, name in connection.map:
        each = system.needs.of(node.key, kind, name)
        if each is None or each.need.lossy is not False:
            continue
        message = (
            f"cannot carry {kind.noun} {name!r}, whose data are declared not lossy, by multicast "
            f"alone, as connection {connection.name!r} does"
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
    """Yield findings about types."""
    yield from _missing(system)
    for family in ("topic", "service", "action"):
        by_name: dict[str, list[Resolved]] = {}
        for each in system.endpoints:
            if each.endpoint.kind.meets_in == family:
                by_name.setdefault(each.name, []).append(each)
        for name, ends in by_name.items():
            yield from _mismatches(family, name, ends)


def _missing(system: DeclaredSystem) -> Iterator[Diagnostic]:
    types_of = functools.cache(lambda package: installed_types.types_of(package, system.prefixes))
    absent: set[str] = set()
    for node in system.manifest.nodes:
        for endpoint in node.interface.endpoints:
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


def _mismatches(family: str, name: str, ends: list[Resolved]) -> Iterator[Diagnostic]:
    first = ends[0]
    for each in ends[1:]:
        if each.endpoint.type != first.endpoint.type:
            message = (
                f"cannot use type {each.endpoint.type!r} for {family} {name!r}: "
                f"{first} uses {first.endpoint.type!r}"
            )
            yield error("check.type-mismatch", each.at, message, "use one type at all ends")


_WORDS = {
    "port": "port",
    "metatraffic_port": "metatraffic port",
    "output_port": "output port",
}


class _Use(msgspec.Struct, frozen=True, kw_only=True):
    """One port that a URL opens."""

    host: str
    tcp: bool
    group: bool
    address: str
    port: int
    what: str
    at: Position


def check_urls(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Yield findings about the URLs of every declared connection."""
    uses = list(_uses(system))
    yield from _port_collisions(uses)
    yield from _well_known(system, uses)
    for node in system.manifest.nodes:
        for connection in node.connections:
            yield from _judge_together(node, connection)


def _uses(system: DeclaredSystem) -> Iterator[_Use]:
    urls = (
        (node, connection, index, url)
        for node in system.manifest.nodes
        for connection in node.connections
        for index, url in enumerate(connection.urls)
    )
    for node, connection, index, url in urls:
        group = url.transport.is_group
        for attribute, word in _WORDS.items():
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
    for use in uses:
        owner = None if use.tcp else owner_of(use.port)
        if owner is None or owner.domain_id != domain:
            continue
        whose = (
            "every participant"
            if owner.participant_id is None
            else f"participant {owner.participant_id}"
        )
        message = (
            f"cannot give UDP port {use.port} to the {use.what}: in domain {domain} it is the "
            f"{owner.role.replace('_', ' ')} port of {whose}"
        )
        base = domain_base(domain)
        hint = f"choose a port outside of {base}–{min(base + DG - 1, 65535)}"
        yield error("check.connection-ports", use.at, message, hint)


def _judge_together(node: Node, connection: ConnectionDeclaration) -> Iterator[Diagnostic]:
    """Judge URLs that one participant cannot have together."""
    try:
        check_together(connection.urls)
    except ConnectionUrlError as refusal:
        at = node.where(f"connections.{connection.name}")
        yield error("check.connection-urls", at, refusal.message, refusal.hint)


CHECKS = (
    check_types,
    check_qos,
    check_counterparts,
    check_connections,
    check_urls,
)
