"""How a participant of connection URLs finds others and is found, in its Fast DDS profile.

Owns: where discovery arrives, whom it is sent to, discovery servers, and how often a participant
announces itself. Must not import rclpy; reads no environment.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Sequence
from xml.etree import ElementTree as ET

from lifecycle.middleware.fastdds.profile_xml import child as _child
from lifecycle.middleware.fastdds.profile_xml import locator as _locator
from lifecycle.middleware.fastdds.profile_xml import tcp_locator as _tcp_locator
from lifecycle.middleware.fastdds.profile_xml import text as _text
from lifecycle.middleware.fastdds.url_families import (
    LOOPBACK,
    TCPV4,
    UDPV4,
    UDPV6,
    Family,
    transport_of,
)
from lifecycle.network.connection_url import ConnectionTransport, ConnectionUrl, Peer
from lifecycle.network.ports import participant_ports

DISCOVERY_GROUP = {UDPV4: "239.255.0.1", UDPV6: "ff1e::ffff:efff:1"}
"""Where Fast DDS 2.14 announces participants by multicast."""

ANNOUNCED_S = 0.5
"""A participant announces itself each so many seconds where nobody can ask it to.

Over TCP Fast DDS 2.14 sends nothing while a connection or a port in it is being agreed on, and
dials again only when there is something to send: what gets lost so comes with the next
announcement, or with the one after it, which by default is 3 s later.
"""

_SERVER_ID_BYTE = 2
"""`fast-discovery-server -i ID` writes ID into the third byte of its GUID prefix."""

_REPLACED = (
    "metatrafficUnicastLocatorList",
    "metatrafficMulticastLocatorList",
    "initialPeersList",
    "avoid_builtin_multicast",
    "mutation_tries",
)


def add_discovery(
    builtin: ET.Element,
    found: Sequence[Family],
    urls: Sequence[ConnectionUrl],
    *,
    domain_id: int,
    super_client: bool,
    localhost_peers: tuple[str, ...] | None,
) -> None:
    """Write discovery into <builtin>, whatever that said of it.

    Args:
        builtin: of the participant's <rtps>.
        found: the transports of the URLs.
        urls: at least one.
        domain_id: 0–232, for TCP's logical ports.
        super_client: be told of everything by the discovery server, not only of what matches.
        localhost_peers: look for others on this host and on these only; for URLs that leave
            discovery open.
    """
    for tag in _REPLACED:
        for element in builtin.findall(tag):
            builtin.remove(element)
    if any(url.server for url in urls):
        _add_servers(builtin, urls, super_client=super_client)
        _add_metatraffic(builtin, found, domain_id, multicast=False)
    elif localhost_peers is not None:
        peers = [Peer(address=each) for each in localhost_peers]
        _add_metatraffic(builtin, found, domain_id, multicast=False)
        _add_peers(builtin, found, extra=peers, loopback=True)
    else:
        multicast = all(url.multicast for url in urls)
        _add_metatraffic(builtin, found, domain_id, multicast=multicast)
        _add_peers(builtin, found, announce=multicast)
        if not multicast:
            _text(builtin, "avoid_builtin_multicast", "true")
    if not all(family.udp for family in found):
        _announce_each(builtin, ANNOUNCED_S)
    if _all_ports_fixed(found):
        # Else Fast DDS would take other ports for busy ones, and nobody would look there.
        _text(builtin, "mutation_tries", "0")


def _add_metatraffic(
    builtin: ET.Element, found: Sequence[Family], domain_id: int, *, multicast: bool
) -> None:
    """Say where discovery arrives, if Fast DDS would not do as asked by itself."""
    fixed = any(url.metatraffic_port for family in found for url in family.urls)
    tcp_alone = all(family.kind == TCPV4 for family in found)
    udp = any(family.udp for family in found)
    if not (fixed or tcp_alone or (udp and not multicast)):
        return
    unicast = ET.SubElement(builtin, "metatrafficUnicastLocatorList")
    for family in found:
        if family.udp:
            port = next((url.metatraffic_port for url in family.urls if url.metatraffic_port), None)
            addresses = dict.fromkeys(url.address for url in family.unicast) or {"": None}
            for address in addresses:
                _locator(unicast, family.kind, address, port)
        elif family.kind == TCPV4:
            logical = participant_ports(domain_id, 0).discovery_unicast
            for url in family.urls:
                _tcp_locator(unicast, url.address, url.port, logical)
    if multicast and udp:  # an empty list would be refused
        groups = ET.SubElement(builtin, "metatrafficMulticastLocatorList")
        for family in found:
            if family.udp:
                _locator(groups, family.kind, DISCOVERY_GROUP[family.kind], None)


def _add_peers(
    builtin: ET.Element,
    found: Sequence[Family],
    *,
    extra: Sequence[Peer] = (),
    loopback: bool = False,
    announce: bool = False,
) -> None:
    searched = ET.Element("initialPeersList")
    for family in found:
        for peer in dict.fromkeys(peer for url in family.urls for peer in url.peers):
            if family.kind == TCPV4:
                _tcp_locator(searched, peer.address, peer.port, None)
            else:
                _locator(searched, family.kind, peer.address, peer.port)
        if family.udp:
            for peer in extra:
                if _may_be(peer.address, family.kind):
                    _locator(searched, family.kind, peer.address, None)
            if loopback:
                _locator(searched, family.kind, LOOPBACK[family.kind], None)
    if len(searched):
        if announce:
            # Named peers replace the groups by which Fast DDS otherwise announces.
            for family in found:
                if family.udp:
                    _locator(searched, family.kind, DISCOVERY_GROUP[family.kind], None)
        builtin.append(searched)


def _add_servers(builtin: ET.Element, urls: Sequence[ConnectionUrl], *, super_client: bool) -> None:
    config = _child(builtin, "discovery_config")
    for tag in ("discoveryProtocol", "discoveryServersList"):
        for element in config.findall(tag):
            config.remove(element)
    _text(config, "discoveryProtocol", "SUPER_CLIENT" if super_client else "CLIENT")
    servers = ET.SubElement(config, "discoveryServersList")
    for url in urls:
        for index, server in enumerate(url.server):
            prefix = _counted(url.server_prefix, index)
            remote = ET.SubElement(servers, "RemoteServer", prefix=prefix)
            listened = ET.SubElement(remote, "metatrafficUnicastLocatorList")
            if url.transport is ConnectionTransport.TCPV4:
                # A server's logical port is its physical one.
                _tcp_locator(listened, server.address, server.port, server.port)
            else:
                _locator(listened, transport_of(url), server.address, server.port)


def _announce_each(builtin: ET.Element, period_s: float) -> None:
    config = _child(builtin, "discovery_config")
    if config.find("leaseAnnouncement") is None:  # the user's own profile may say it
        period = ET.SubElement(config, "leaseAnnouncement")
        _text(period, "nanosec", str(round(period_s * 1e9)))


def _counted(prefix: str, index: int) -> str:
    octets = prefix.split(".")
    octets[_SERVER_ID_BYTE] = f"{(int(octets[_SERVER_ID_BYTE], 16) + index) & 0xFF:02x}"
    return ".".join(octets)


def _all_ports_fixed(found: Sequence[Family]) -> bool:
    # Shared memory has ports of its own, which must stay free to move.
    return all(
        family.udp
        and any(url.metatraffic_port for url in family.urls)
        and family.unicast
        and all(url.port for url in family.unicast)
        for family in found
    )


def _may_be(address: str, kind: str) -> bool:
    """Whether a peer can be reached by a family; a name may be, by any."""
    try:
        version = ipaddress.ip_address(address).version
    except ValueError:
        return True
    return kind == f"udpv{version}"
