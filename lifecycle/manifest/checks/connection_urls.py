"""Checks of connection URLs: conflicting ports, addresses of the machine, combined URLs.

Owns: check.connection-ports, check.connection-address, check.connection-urls. Pure.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Iterator

import msgspec

from lifecycle.manifest.checks.system import DeclaredSystem
from lifecycle.manifest.diagnostics import Diagnostic, Position
from lifecycle.manifest.model import (
    ConnectionDeclaration,
    DiscoveryMode,
    EndpointKind,
    Node,
)
from lifecycle.manifest.yaml.document import error
from lifecycle.network.connection_url import ConnectionUrl, ConnectionUrlError, check_together
from lifecycle.network.nfe import is_loopback, may_be_same
from lifecycle.network.ports import DG, domain_base, owner_of

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
    uses: list[_Use] = []
    for node, connection, url, at in _urls(system):
        uses += _uses(system, node, connection, url, at)
        yield from _own_address(system, node, url, at)
    yield from _collisions(uses)
    yield from _well_known(system, uses)
    for node, connection, url, at in _urls(system):
        yield from _loopback(system, node, connection, url, at)
    for node in system.manifest.nodes:
        for connection in node.connections:
            yield from _together(node, connection)


def _urls(
    system: DeclaredSystem,
) -> Iterator[tuple[Node, ConnectionDeclaration, ConnectionUrl, Position]]:
    for node in system.manifest.nodes:
        for connection in node.connections:
            for index, url in enumerate(connection.urls):
                yield (
                    node,
                    connection,
                    url,
                    node.where(f"connections.{connection.name}.urls.{index}"),
                )


def _uses(
    system: DeclaredSystem,
    node: Node,
    connection: ConnectionDeclaration,
    url: ConnectionUrl,
    at: Position,
) -> Iterator[_Use]:
    for attribute, word in _WORDS.items():
        port = getattr(url, attribute)
        if port is None:
            continue
        group = url.transport.is_group
        yield _Use(
            host=system.manifest.address_of(node.machine),
            tcp=url.transport.is_tcp,
            group=group and attribute == "port",
            address="" if group or attribute == "output_port" else url.address,
            port=port,
            what=f"{word} of connection {connection.name!r} of {node.key!r}",
            at=at,
        )


def _own_address(
    system: DeclaredSystem, node: Node, url: ConnectionUrl, at: Position
) -> Iterator[Diagnostic]:
    host = system.manifest.address_of(node.machine)
    if not host or not url.address or url.transport.is_group:
        return
    own = ipaddress.ip_address(url.address)
    if own.is_loopback or own.is_unspecified or own == ipaddress.ip_address(host):
        return
    if own.version != ipaddress.ip_address(host).version:
        return  # a host has addresses of both kinds, and a machine is declared with one
    message = (
        f"cannot listen on {url.address!r} for {node.key!r}: its machine {node.machine!r} has the "
        f"address {host}"
    )
    hint = "leave the address out to listen on every interface"
    yield error("check.connection-address", at, message, hint)


def _collisions(uses: list[_Use]) -> Iterator[Diagnostic]:
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


def _loopback(
    system: DeclaredSystem,
    node: Node,
    connection: ConnectionDeclaration,
    url: ConnectionUrl,
    at: Position,
) -> Iterator[Diagnostic]:
    """Judge loopback addresses where what is carried has an end elsewhere."""
    if url.transport.is_group:
        return
    local = [str(each) for each in url.peers if is_loopback(each.address)]
    if is_loopback(url.address):
        local.insert(0, url.address)
    if not local or any(not is_loopback(each.address) for each in url.peers):
        return
    for kind, name in connection.map:
        for key in _remote_nodes(system, node, kind, name):
            message = (
                f"cannot reach {key!r}, which {name!r} of {node.key!r} is for, by {local[0]!r}: "
                "a loopback address never leaves its host, and they are on different machines"
            )
            yield error("check.connection-address", at, message, "use the machines' addresses")
            return


def _remote_nodes(
    system: DeclaredSystem, node: Node, kind: EndpointKind, name: str
) -> Iterator[str]:
    """Yield nodes of other hosts that have the other end of a topic."""
    mine = [
        each.name
        for each in system.endpoints
        if each.node.key == node.key and (each.endpoint.kind, each.endpoint.name) == (kind, name)
    ]
    if not kind.is_topic or not mine:
        return
    host = system.manifest.address_of(node.machine)
    for each in system.named(kind.other_end, mine[0]):
        if system.manifest.address_of(each.node.machine) != host:
            yield each.node.key


def _together(node: Node, connection: ConnectionDeclaration) -> Iterator[Diagnostic]:
    """Judge URLs that one participant cannot have together."""
    try:
        check_together(connection.urls)
    except ConnectionUrlError as refusal:
        at = node.where(f"connections.{connection.name}")
        yield error("check.connection-urls", at, refusal.message, refusal.hint)


CHECKS = (check_urls,)
