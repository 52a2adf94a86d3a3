"""How supervisors' own participants are connected, so that they see what they must judge.

Owns: `connect_observers`. An observer is on the control plane like the nodes' own participants; for
connections by other transports it gets those as well, as far as one participant can have them:
where ports are fixed, not shared memory beside UDP. Pure.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

from lifecycle.manifest.model import FlowTransport
from lifecycle.network.connection_url import ConnectionTransport, ConnectionUrl, parse
from lifecycle.plan.connections.contacts import Contact, contacts_of, peers_by
from lifecycle.plan.connections.control import Control
from lifecycle.plan.connections.hosts import LOOPBACK, Hosts
from lifecycle.plan.model import ParticipantConnections, PlannedNode

_KINDS = {
    ConnectionTransport.UDPV4: "udpv4",
    ConnectionTransport.UDPM: "udpv4",
    ConnectionTransport.UDPV6: "udpv6",
    ConnectionTransport.TCPV4: "tcpv4",
}


def with_tcp(control: Control, hosts: Hosts) -> tuple[tuple[str, ParticipantConnections], ...]:
    """Return the observers as they are if they must also be found by TCP."""
    return tuple(
        (
            host,
            dataclasses.replace(base, urls=tuple(map(str, _with_tcp(base, control, host, hosts)))),
        )
        for host, base in _bases(control, hosts).items()
    )


def connect_observers(
    nodes: Sequence[PlannedNode],
    hosts: Hosts,
    control: Control,
    *,
    fixed: bool,
    may_use_tcp: bool = False,
) -> tuple[tuple[str, ParticipantConnections], ...]:
    """Return how the observer of each host is connected.

    Args:
        nodes: with all their connections.
        hosts: of the system.
        control: what own participants have.
        fixed: nobody is found by multicast.
        may_use_tcp: connections that are not planned may use TCP.

    Returns:
        (host, connections); nothing for a host whose observer the RMW may connect.
    """
    urls = [
        (hosts.host(node.machine), parse(text))
        for node in nodes
        for each in node.participants
        if each.connection and not each.connections.static_participants
        for text in each.connections.urls
    ]
    kinds = {_KINDS[url.transport] for _, url in urls if url.transport in _KINDS}
    if may_use_tcp:
        kinds.add("tcpv4")
    # Whoever is found by multicast, or looks for the observer, need not be looked for.
    ours = {
        contact.peer
        for host, each in with_tcp(control, hosts)
        for contact in contacts_of(host, each.urls)
    }
    contacts = [
        contact
        for host, url in urls
        if not url.multicast or url.transport is ConnectionTransport.TCPV4
        if not ours & {*url.peers}
        for contact in contacts_of(host, (str(url),))
    ]
    if fixed:
        kinds -= {"udpv4", "udpv6"}
    found = (
        (host, _observer(host, base, kinds, contacts, control, hosts))
        for host, base in _bases(control, hosts).items()
    )
    return tuple((host, each) for host, each in found if each.urls)


def _bases(control: Control, hosts: Hosts) -> Mapping[str, ParticipantConnections]:
    known = dict(control.observers)
    return {host: known.get(host, ParticipantConnections()) for host in hosts.used}


def _observer(  # noqa: PLR0917 - all are needed, and it is called once
    host: str,
    base: ParticipantConnections,
    kinds: set[str],
    contacts: Sequence[Contact],
    control: Control,
    hosts: Hosts,
) -> ParticipantConnections:
    if control.server is not None:
        return base  # it is told of everything
    own = {contact.peer for contact in contacts_of(host, base.urls)}
    wanted = [each for each in contacts if each.peer not in own]
    urls = _urls(base)
    has = {_KINDS[url.transport] for url in urls if url.transport in _KINDS}
    needed = kinds - has
    if not needed and not any(_peers(url, wanted, host) for url in urls):
        return base
    if "tcpv4" in needed:
        urls = _with_tcp(base, control, host, hosts)
    for kind in ("udpv4", "udpv6"):
        if kind in needed:
            urls.append(ConnectionUrl(transport=ConnectionTransport(kind)))
    return dataclasses.replace(base, urls=tuple(str(_meeting(url, wanted, host)) for url in urls))


def _urls(base: ParticipantConnections) -> list[ConnectionUrl]:
    """Return the URLs of an observer; where the RMW chooses, what it would choose."""
    return [parse(text) for text in base.urls] or [
        ConnectionUrl(transport=ConnectionTransport.SHM),
        ConnectionUrl(transport=ConnectionTransport.UDPV4),
    ]


def _with_tcp(
    base: ParticipantConnections, control: Control, host: str, hosts: Hosts
) -> list[ConnectionUrl]:
    urls = _urls(base)
    if control.transport is FlowTransport.TCPV4:
        return urls
    port = dict(control.observer_ports)[host][3]
    # TCP is IPv4 here; where the host is declared by IPv6, only its own nodes can use it.
    address = LOOPBACK if ":" in host else hosts.address(host) if host or not hosts.several else ""
    return [
        *urls,
        ConnectionUrl(transport=ConnectionTransport.TCPV4, address=address, port=port),
    ]


def _peers(url: ConnectionUrl, contacts: Sequence[Contact], host: str) -> tuple[Contact, ...]:
    known = set(peers_by(url.transport, contacts, host=host)) - {*url.peers}
    return tuple(each for each in contacts if each.peer in known)


def _meeting(url: ConnectionUrl, contacts: Sequence[Contact], host: str) -> ConnectionUrl:
    """Return a URL that also looks for these."""
    new = {each.peer for each in _peers(url, contacts, host)}
    return dataclasses.replace(url, peers=(*url.peers, *sorted(new)))
