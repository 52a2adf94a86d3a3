"""Discovery addresses and ports of participants, peers (static peers), as far as they are planned.

Owns: `Contact`, reading contacts out of connection URLs, spelling the URL of a participant whose
ports are fixed, and `reached_hosts`, where multicast alone may not reach every participant. Pure.
"""

from __future__ import annotations

import dataclasses
import ipaddress
from collections.abc import Collection, Iterable, Mapping, Sequence

from lifecycle.manifest import DiscoveryMode, DiscoveryRange, FlowTransport
from lifecycle.network import ConnectionUrl, Medium, Peer, parse
from lifecycle.plan.model import Plan

_SPARE = 4
"""Participants of other systems and tools on a host, which take ports before or between ours."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True, order=True)
class Contact:
    """Where one participant's discovery is reached.

    Attributes:
        host: its host, see `lifecycle.plan.connections.hosts`.
        transport: UDPV4, UDPV6 or TCPV4.
        peer: address and port, as `peer=` of a connection URL.
    """

    host: str
    transport: Medium
    peer: Peer


def contacts_of(host: str, urls: Iterable[str]) -> tuple[Contact, ...]:
    """Return where a participant with these URLs is reached; nothing where the RMW chooses."""
    found = []
    for text in urls:
        url = parse(text)
        contact = _contact(host, url)
        if contact is not None:
            found.append(contact)
    return tuple(found)


def _contact(host: str, url: ConnectionUrl) -> Contact | None:
    address, port = url.address, url.metatraffic_port
    if url.transport is Medium.UDPM:
        # The group is for data; discovery listens on the interfaces.
        address = next(iter(url.interfaces), "")
    elif url.transport is Medium.TCPV4:
        port = url.port
    if port is None:
        return None
    return Contact(
        host=host,
        transport=url.transport.unicast,
        peer=Peer(address=address or host or "127.0.0.1", port=port),
    )


def ports_of(urls: Iterable[ConnectionUrl]) -> tuple[int, ...]:
    """Return the ports that a participant opens by these URLs, groups' left out."""
    return tuple(
        port
        for url in urls
        for port in (
            None if url.transport is Medium.UDPM else url.port,
            url.metatraffic_port,
            url.output_port,
        )
        if port is not None
    )


def peers_by(transport: Medium, contacts: Iterable[Contact], *, host: str) -> tuple[Peer, ...]:
    """Return the peers that a URL of this transport can look for, sorted, each once.

    Args:
        transport: of the URL.
        contacts: all participants to be found.
        host: of the participant with the URL; a group with TTL 0 reaches no other host.
    """
    group = transport is Medium.UDPM
    return tuple(
        sorted(
            {
                each.peer
                for each in contacts
                if each.transport == transport.unicast and (not group or each.host == host)
            }
        )
    )


def fixed_url(
    transport: Medium,
    address: str,
    ports: Sequence[int],
    peers: Sequence[Peer],
) -> ConnectionUrl:
    """Return the URL of a participant that only these peers find.

    Args:
        transport: UDPV4, UDPV6 or TCPV4.
        address: own.
        ports: metatraffic, user data and source port for UDP; the listening port for TCP.
        peers: whom it looks for.
    """
    if transport is Medium.TCPV4:
        return ConnectionUrl(
            transport=transport, address=address, port=ports[0], peers=tuple(peers)
        )
    metatraffic, user, output = ports
    return ConnectionUrl(
        transport=transport,
        address=address,
        port=user,
        metatraffic_port=metatraffic,
        output_port=output,
        peers=tuple(peers),
        multicast=False,
    )


def reached_hosts(plan: Plan, own: Collection[str]) -> Mapping[str, int]:
    """Return the other hosts of a system that are looked for by address, beside multicast.

    A router does not pass multicast. Where discovery finds any participant, beyond this host, the
    addresses of `machines:` are as good as ROS_STATIC_PEERS; other modes have their own peers.
    IPv6 hosts are found by multicast only: rmw_fastrtps resolves no IPv6 address of a peer.

    Args:
        plan: the system.
        own: machines that are this host.

    Returns:
        By IPv4 address, how many participants may be there: the supervisor, each process, each
        participant that the plan adds, and a few of others.
    """
    far = plan.discovery_range in (DiscoveryRange.SUBNET, DiscoveryRange.SYSTEM_DEFAULT)
    by_ipv4 = plan.discovery.transport in (FlowTransport.ANY, FlowTransport.UDPV4)
    if plan.discovery_mode is not DiscoveryMode.DYNAMIC or not far or not by_ipv4:
        return {}
    hosts: dict[str, int] = {}
    for machine in plan.machines:
        if machine.name in own or not machine.address:
            continue
        address = ipaddress.ip_address(machine.address)
        nodes = [each for each in plan.nodes if each.machine == machine.name]
        if nodes and address.version == 4 and not address.is_loopback:
            count = len({each.process for each in nodes})
            count += sum(len(each.participants) for each in nodes)
            hosts[str(address)] = hosts.get(str(address), 1 + _SPARE) + count
    return hosts
