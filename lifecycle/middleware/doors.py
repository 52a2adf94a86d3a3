"""Where to knock for everybody that an observer could meet.

Owns: which participants' discovery ports are asked, for what the environment says of discovery and
for connection URLs, and where that is impossible: nobody can be asked over shared memory or TCP,
nor behind a discovery server. Must not import rclpy.
"""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Iterable, Iterator, Mapping, Sequence

import psutil

from lifecycle.middleware.knock import RANGE_VARIABLE, Door, Knock, discovery_ports
from lifecycle.middleware.url_discovery import DISCOVERY_GROUP
from lifecycle.middleware.url_families import (
    LOOPBACK,
    UDPV4,
    UDPV6,
    Family,
    families,
    leaves_discovery_open,
)
from lifecycle.middleware.url_profile import LOCALHOST_PEERS_RANGE
from lifecycle.network.connection_url import ConnectionUrl
from lifecycle.network.ports import PARTICIPANTS_PER_DOMAIN, participant_ports

_FAMILIES = {UDPV4: socket.AF_INET, UDPV6: socket.AF_INET6}


def knock_for(
    domain_id: int, urls: Sequence[ConnectionUrl], environment: Mapping[str, str]
) -> tuple[Knock, ...]:
    """Ask everybody whom an observer with these URLs could meet; close what is returned.

    Args:
        domain_id: 0–232.
        urls: the observer's; none for what the RMW does by itself. Its participant listens already.
        environment: where ROS_AUTOMATIC_DISCOVERY_RANGE is looked up, for URLs that leave discovery
            open. OFF asks nobody, SUBNET (the default) asks this host and by multicast, everything
            else this host only.

    Returns:
        One per address family; none where it is impossible to ask.
    """
    found = families(urls)
    if not all(family.udp for family in found) or any(url.server for url in urls):
        return ()
    if urls and not leaves_discovery_open(urls):
        return tuple(_knock_at_peers(domain_id, family) for family in found)
    range_ = environment.get(RANGE_VARIABLE, "").upper() or "SUBNET"
    return tuple(
        _knock_around(domain_id, kind, range_)
        for kind in (tuple(family.kind for family in found) or (UDPV4,))
    )


def _knock_around(domain_id: int, kind: str, range_: str) -> Knock:
    if range_ == "OFF":
        return Knock((), (), ())
    by_interface = _addresses(kind) if range_ == "SUBNET" else {}
    doors = [
        *_well_known(domain_id, LOOPBACK[kind], PARTICIPANTS_PER_DOMAIN),
        *_groups(domain_id, kind, by_interface),
    ]
    addresses = (LOOPBACK[kind], *(each for found in by_interface.values() for each in found))
    return Knock(doors, addresses, discovery_ports(domain_id, kind))


def _knock_at_peers(domain_id: int, family: Family) -> Knock:
    doors: list[Door] = []
    for peer in dict.fromkeys(peer for url in family.urls for peer in url.peers):
        if peer.port is None:
            doors += _well_known(domain_id, peer.address, LOCALHOST_PEERS_RANGE)
        else:
            doors.append(Door(address=peer.address, port=peer.port))
    here = _addresses(family.kind, loopback=True)
    if family.interfaces:
        bound = set(family.interfaces)
        here = {
            name: addresses if name in bound else tuple(a for a in addresses if a in bound)
            for name, addresses in here.items()
        }
    if all(url.multicast for url in family.urls):
        doors += _groups(domain_id, family.kind, {n: each for n, each in here.items() if each})
    addresses = tuple(each for found in here.values() for each in found)
    fixed = [url.metatraffic_port for url in family.urls if url.metatraffic_port]
    output = next((url.output_port for url in family.urls if url.output_port), None)
    heard_at = fixed[:1] or discovery_ports(domain_id, family.kind)
    return Knock(doors, addresses, heard_at, output_port=output)


def _well_known(domain_id: int, address: str, participants: int) -> Iterator[Door]:
    for participant in range(participants):
        try:
            port = participant_ports(domain_id, participant).discovery_unicast
        except ValueError:  # the domain has no such port
            return
        yield Door(address=address, port=port)


def _groups(domain_id: int, kind: str, interfaces: Iterable[str]) -> Iterator[Door]:
    port = participant_ports(domain_id, 0).discovery_multicast
    for interface in interfaces:
        yield Door(address=DISCOVERY_GROUP[kind], port=port, interface=interface)


def _addresses(kind: str, *, loopback: bool = False) -> dict[str, tuple[str, ...]]:
    """Return this host's addresses of a family by interface; interfaces without one are left out.

    Link-local ones of IPv6 mean nothing to others without an interface of theirs.
    """
    found = {}
    for name, entries in sorted(psutil.net_if_addrs().items()):
        texts = [each.address for each in entries if each.family is _FAMILIES[kind]]
        addresses = [ipaddress.ip_address(text.partition("%")[0]) for text in texts]
        kept = [
            str(each)
            for each in addresses
            if (loopback or not each.is_loopback) and not (each.version == 6 and each.is_link_local)
        ]
        if kept:
            found[name] = tuple(kept)
    return found
