"""Checks of connection URLs: conflicting ports, combined URLs. Pure."""

from __future__ import annotations

from collections.abc import Iterator

import msgspec

from lifecycle.manifest.checks.system import DeclaredSystem
from lifecycle.manifest.diagnostics import Diagnostic, Position
from lifecycle.manifest.model import (
    ConnectionDeclaration,
    DiscoveryMode,
    Node,
)
from lifecycle.manifest.yaml.document import error
from lifecycle.network.connection_url import ConnectionUrl, ConnectionUrlError, check_together
from lifecycle.network.nfe import may_be_same
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
    uses = list(_uses(system))
    yield from _collisions(uses)
    yield from _well_known(system, uses)
    for node in system.manifest.nodes:
        for connection in node.connections:
            yield from _together(node, connection)


def _uses(system: DeclaredSystem) -> Iterator[_Use]:
    for node in system.manifest.nodes:
        for connection in node.connections:
            for index, url in enumerate(connection.urls):
                at = node.where(f"connections.{connection.name}.urls.{index}")
                host = system.manifest.address_of(node.machine)
                what = f"of connection {connection.name!r} of {node.key!r}"
                yield from _ports(url, host, what, at)


def _ports(url: ConnectionUrl, host: str, what: str, at: Position) -> Iterator[_Use]:
    group = url.transport.is_group
    for attribute, word in _WORDS.items():
        port = getattr(url, attribute)
        if port is not None:
            yield _Use(
                host=host,
                tcp=url.transport.is_tcp,
                group=group and attribute == "port",
                address="" if group or attribute == "output_port" else url.address,
                port=port,
                what=f"{word} {what}",
                at=at,
            )


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


def _together(node: Node, connection: ConnectionDeclaration) -> Iterator[Diagnostic]:
    """Judge URLs that one participant cannot have together."""
    try:
        check_together(connection.urls)
    except ConnectionUrlError as refusal:
        at = node.where(f"connections.{connection.name}")
        yield error("check.connection-urls", at, refusal.message, refusal.hint)


CHECKS = (check_urls,)
