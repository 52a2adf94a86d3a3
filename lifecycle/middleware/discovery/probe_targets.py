"""Where to knock for everybody that an observer could meet.

Owns: which participants' discovery ports are asked, for what the environment says of discovery and
for connection URLs, and where that is impossible: nobody can be asked over shared memory or TCP,
nor behind a discovery server. Nothing is sent where the system's own discovery would send nothing.
Must not import rclpy.
"""

from __future__ import annotations

import contextlib
import ipaddress
import socket
from collections.abc import Iterable, Iterator, Mapping, Sequence

import psutil

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.discovery.probe import RANGE_VARIABLE, Door, Knock, discovery_ports
from lifecycle.middleware.fastdds.participant_profile import default_profile
from lifecycle.middleware.fastdds.profiles import PROFILE_NAME
from lifecycle.middleware.fastdds.url_discovery import DISCOVERY_GROUP
from lifecycle.middleware.fastdds.url_families import (
    LOOPBACK,
    UDPV4,
    UDPV6,
    Family,
    families,
    leaves_discovery_open,
)
from lifecycle.middleware.fastdds.url_profile import LOCALHOST_PEERS_RANGE
from lifecycle.network.connection_url import ConnectionUrl
from lifecycle.network.ports import PARTICIPANTS_PER_DOMAIN, participant_ports

PEERS_VARIABLE = "ROS_STATIC_PEERS"
_WITH_UDP = ("", "DEFAULT", "UDPV4", "LARGE_DATA")
_CHOICES = frozenset(
    {
        "userTransports",
        "builtinTransports",
        "discoveryProtocol",
        "initialPeersList",
        "metatrafficMulticastLocatorList",
        "metatrafficUnicastLocatorList",
        "avoid_builtin_multicast",
    }
)
"""Elements of a participant profile that say where others are looked for, or by what."""

_FAMILIES = {UDPV4: socket.AF_INET, UDPV6: socket.AF_INET6}


def knock_for(
    domain_id: int, urls: Sequence[ConnectionUrl], environment: Mapping[str, str]
) -> tuple[Knock, ...]:
    """Ask everybody whom an observer with these URLs could meet; close what is returned.

    Args:
        domain_id: 0–232.
        urls: the observer's; none for what the RMW does by itself. Its participant listens already.
        environment: where ROS_AUTOMATIC_DISCOVERY_RANGE is looked up, for URLs that leave discovery
            open. OFF asks nobody, SUBNET (the default) asks this host, by multicast, and those of
            ROS_STATIC_PEERS, everything else this host only.

    Returns:
        One per address family; none where it is impossible to ask.
    """
    found = families(urls)
    if not all(family.udp for family in found) or any(url.server for url in urls):
        return ()
    if not urls and chosen_otherwise(environment):
        return ()
    if urls and not leaves_discovery_open(urls):
        return tuple(_knock_at_peers(domain_id, family) for family in found)
    range_ = _range(environment)
    return tuple(
        _knock_around(domain_id, kind, range_, environment)
        for kind in (tuple(family.kind for family in found) or (UDPV4,))
    )


def doors_of(
    domain_id: int, urls: Sequence[ConnectionUrl], environment: Mapping[str, str]
) -> tuple[tuple[str, tuple[Door, ...]], ...]:
    """Return where everybody is reached by UDP whom an observer with these URLs could meet.

    Args:
        domain_id: 0–232.
        urls: the observer's; none for what the RMW does by itself.
        environment: as for `knock_for`.

    Returns:
        "udpv4" or "udpv6" and the doors of that family; nothing where discovery allows no UDP.
    """
    if any(url.server for url in urls) or (not urls and chosen_otherwise(environment)):
        return ()
    found = tuple(family for family in families(urls) if family.udp)
    if urls and not leaves_discovery_open(urls):
        return tuple(
            (family.kind, _doors_of_peers(domain_id, family, _bound(family))) for family in found
        )
    range_ = _range(environment)
    return tuple(
        (kind, _doors_around(domain_id, kind, range_, environment))
        for kind in (tuple(family.kind for family in found) or (() if urls else (UDPV4,)))
        if range_ != "OFF"
    )


def _range(environment: Mapping[str, str]) -> str:
    return environment.get(RANGE_VARIABLE, "").upper() or "SUBNET"


def chosen_otherwise(environment: Mapping[str, str]) -> bool:
    """Whether the user's own settings of Fast DDS say how participants without URLs are found.

    A discovery server, transports, or where to look for others: then nobody may be asked over UDP,
    which those settings may have ruled out.
    """
    if environment.get("ROS_DISCOVERY_SERVER") or not _has_udpv4(environment):
        return True
    try:
        profile = default_profile(environment)
    except MiddlewareError:  # Fast DDS cannot read it either, and takes its defaults
        return False
    if profile is None or profile.name == PROFILE_NAME:  # ours adds to the default
        return False
    return any(each.tag in _CHOICES for each in profile.element.iter())


def _has_udpv4(environment: Mapping[str, str]) -> bool:
    builtin = environment.get("FASTDDS_BUILTIN_TRANSPORTS", "").partition("?")[0].upper()
    return builtin in _WITH_UDP


def static_peers(environment: Mapping[str, str]) -> tuple[str, ...]:
    """Return the addresses among ROS_STATIC_PEERS; a name would have to be looked up."""
    found = []
    for text in environment.get(PEERS_VARIABLE, "").split(";"):
        with contextlib.suppress(ValueError):
            found.append(str(ipaddress.ip_address(text.strip())))
    return tuple(found)


def peers_environment(hosts: Iterable[str], environment: Mapping[str, str]) -> Mapping[str, str]:
    """Return ROS_STATIC_PEERS with these hosts beside those of the user's; rmw reads it.

    It looks at the first four participants of each, and only with the range SUBNET. Participants
    without UDP over IPv4 would look for nobody else then, so where the user's settings take it
    away, nothing is added.

    Args:
        hosts: IPv4 addresses.
        environment: what it is now.
    """
    if environment.get("ROS_DISCOVERY_SERVER") or not _has_udpv4(environment):
        return {}
    given = [each.strip() for each in environment.get(PEERS_VARIABLE, "").split(";")]
    every = dict.fromkeys([*filter(None, given), *hosts])
    return {PEERS_VARIABLE: ";".join(every)} if every else {}


def discovery_peers(
    domain_id: int, hosts: Mapping[str, int], environment: Mapping[str, str]
) -> tuple[tuple[str, int], ...]:
    """Return where participants of these hosts are looked for, beside multicast.

    Args:
        domain_id: 0–232.
        hosts: by IP address, how many participants may be there.
        environment: where settings of Fast DDS are looked up.

    Returns:
        Address and UDP port, the groups of multicast among them; nothing without hosts, or where
        the user's own settings say how others are found.
    """
    if not hosts or chosen_otherwise(environment):
        return ()
    found = [
        (door.address, door.port)
        for host, count in hosts.items()
        for door in well_known_doors(domain_id, host, min(count, LOCALHOST_PEERS_RANGE))
    ]
    group = participant_ports(domain_id, 0).discovery_multicast
    return ((DISCOVERY_GROUP[UDPV4], group), *found)


def _knock_around(domain_id: int, kind: str, range_: str, environment: Mapping[str, str]) -> Knock:
    if range_ == "OFF":
        return Knock((), (), ())
    doors = _doors_around(domain_id, kind, range_, environment)
    by_interface = addresses_of(kind) if range_ == "SUBNET" else {}
    addresses = (LOOPBACK[kind], *(each for found in by_interface.values() for each in found))
    return Knock(doors, addresses, discovery_ports(domain_id, kind))


def _doors_around(
    domain_id: int, kind: str, range_: str, environment: Mapping[str, str]
) -> tuple[Door, ...]:
    """Return this host's ports, and with the range SUBNET the group and the static peers'."""
    doors = [*well_known_doors(domain_id, LOOPBACK[kind], PARTICIPANTS_PER_DOMAIN)]
    if range_ == "SUBNET":
        doors += group_doors(domain_id, kind, addresses_of(kind))
        for peer in static_peers(environment):
            if (":" in peer) == (kind == UDPV6):
                doors += well_known_doors(domain_id, peer, LOCALHOST_PEERS_RANGE)
    return tuple(doors)


def _bound(family: Family) -> dict[str, tuple[str, ...]]:
    """Return this host's addresses that a family of URLs is bound to, by interface."""
    here = addresses_of(family.kind, loopback=True)
    if family.interfaces:
        bound = set(family.interfaces)
        here = {
            name: addresses if name in bound else tuple(a for a in addresses if a in bound)
            for name, addresses in here.items()
        }
    return here


def _doors_of_peers(
    domain_id: int, family: Family, here: Mapping[str, tuple[str, ...]]
) -> tuple[Door, ...]:
    doors: list[Door] = []
    for peer in dict.fromkeys(peer for url in family.urls for peer in url.peers):
        if peer.port is None:
            doors += well_known_doors(domain_id, peer.address, LOCALHOST_PEERS_RANGE)
        else:
            doors.append(Door(address=peer.address, port=peer.port))
    if all(url.multicast for url in family.urls):
        doors += group_doors(domain_id, family.kind, {n: each for n, each in here.items() if each})
    return tuple(doors)


def _knock_at_peers(domain_id: int, family: Family) -> Knock:
    here = _bound(family)
    doors = _doors_of_peers(domain_id, family, here)
    addresses = tuple(each for found in here.values() for each in found)
    fixed = [url.metatraffic_port for url in family.urls if url.metatraffic_port]
    output = next((url.output_port for url in family.urls if url.output_port), None)
    heard_at = fixed[:1] or discovery_ports(domain_id, family.kind)
    return Knock(doors, addresses, heard_at, output_port=output)


def well_known_doors(domain_id: int, address: str, participants: int) -> Iterator[Door]:
    """Yield the discovery ports of a host's first participants (DDSI-RTPS 9.6.2.3)."""
    for participant in range(participants):
        try:
            port = participant_ports(domain_id, participant).discovery_unicast
        except ValueError:  # the domain has no such port
            return
        yield Door(address=address, port=port)


def group_doors(domain_id: int, kind: str, interfaces: Iterable[str]) -> Iterator[Door]:
    """Yield the group of discovery by each interface."""
    port = participant_ports(domain_id, 0).discovery_multicast
    for interface in interfaces:
        yield Door(address=DISCOVERY_GROUP[kind], port=port, interface=interface)


def addresses_of(kind: str, *, loopback: bool = False) -> dict[str, tuple[str, ...]]:
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
