"""Transports of a participant in its Fast DDS profile, with their locators and discovery.

Owns: the grouping of connection URLs into Fast DDS transports, and which URLs one participant
cannot have together; the XML of transports, of where data and discovery arrive and discovery is
sent to, and of discovery servers. Must not import rclpy; reads no environment.

Two URLs of one family (IPv4 UDP and a group over IPv4) share one transport: with two of a kind Fast
DDS would send everything twice.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from xml.etree import ElementTree as ET

import msgspec

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.fastdds.profiles import child, drop, text
from lifecycle.middleware.versions import installed
from lifecycle.network.connection_url import ConnectionUrl, Peer
from lifecycle.network.medium import Medium, udp_to
from lifecycle.network.nfe import is_wildcard, parse_address
from lifecycle.network.ports import LOCALHOST_PEERS_RANGE, participant_ports

DISCOVERY_GROUP = {Medium.UDPV4: "239.255.0.1", Medium.UDPV6: "ff1e::ffff:efff:1"}
"""Where Fast DDS announces participants by multicast."""

_TYPES = {Medium.UDPV4: "UDPv4", Medium.UDPV6: "UDPv6", Medium.TCPV4: "TCPv4", Medium.SHM: "SHM"}
"""What a profile calls the transports."""

_SERVER_ID_BYTE = 2
"""`fast-discovery-server -i ID` writes ID into the third byte of its GUID prefix."""

_UNICAST, _GROUPS = _DATA = ("defaultUnicastLocatorList", "defaultMulticastLocatorList")
_DISCOVERY_UNICAST, _DISCOVERY_GROUPS, _SEARCHED = _DISCOVERY = (
    "metatrafficUnicastLocatorList",
    "metatrafficMulticastLocatorList",
    "initialPeersList",
)


class UrlTransport(msgspec.Struct, frozen=True, kw_only=True):
    """One transport of a participant: all URLs that it serves.

    Attributes:
        kind: UDPV4, UDPV6, TCPV4 or SHM.
        urls: none where it is as Fast DDS has it by default.
        interfaces: addresses or names that it is bound to; empty for all.
    """

    kind: Medium
    urls: tuple[ConnectionUrl, ...] = ()
    interfaces: tuple[str, ...] = ()

    @property
    def peers(self) -> tuple[Peer, ...]:
        """Who its URLs say is looked for, each once."""
        return tuple(dict.fromkeys(peer for url in self.urls for peer in url.peers))

    @property
    def metatraffic_port(self) -> int | None:
        """The port for discovery that its URLs name, if one does."""
        return next((url.metatraffic_port for url in self.urls if url.metatraffic_port), None)


def families(urls: Sequence[ConnectionUrl]) -> tuple[UrlTransport, ...]:
    """Return the transports that a participant of these URLs has, in the order of the URLs.

    Raises:
        MiddlewareError: URLs that one participant cannot have together.
    """
    by_kind: dict[Medium, list[ConnectionUrl]] = {}
    for url in urls:
        kind = udp_to(url.address) if url.transport.is_group else url.transport
        by_kind.setdefault(kind, []).append(url)
    found = tuple(
        UrlTransport(kind=kind, urls=tuple(each), interfaces=_interfaces(each))
        for kind, each in by_kind.items()
    )
    _check(found, urls)
    return found


def leaves_discovery_open(urls: Iterable[ConnectionUrl]) -> bool:
    """Whether UDP URLs say nothing of where others are looked for.

    Then what the environment says of that still holds (ROS_AUTOMATIC_DISCOVERY_RANGE).
    """
    udp = [url for url in urls if url.transport.is_udp]
    return bool(udp) and not any(
        url.peers
        or url.server
        or not url.multicast
        or url.metatraffic_port
        or url.interfaces
        or (url.address and not url.transport.is_group)
        for url in udp
    )


def add_transports(
    name: str,
    profiles: ET.Element,
    rtps: ET.Element,
    found: Sequence[UrlTransport],
    *,
    domain_id: int,
    super_client: bool = False,
    non_blocking_send: bool = False,
    localhost_peers: tuple[str, ...] | None = None,
) -> None:
    """Write transports, locators and discovery of a participant into its profile.

    Args:
        name: prefix of the transports' names.
        profiles: gets <transport_descriptors>.
        rtps: the participant's; what it said of locators and discovery is replaced by URLs.
        found: all transports that it gets.
        domain_id: 0–232, for TCP's logical ports.
        super_client: receive everything from the discovery server, not only of what matches.
        non_blocking_send: on every UDP transport, whatever its URLs say.
        localhost_peers: look for others on this host and on these only; for URLs that leave
            discovery open. None leaves that to rmw.
    """
    urls = [url for family in found for url in family.urls]
    builtin = child(rtps, "builtin")
    lists = {tag: ET.Element(tag) for tag in (*_DATA, *_DISCOVERY)}
    if urls:
        drop(rtps, *_DATA)
        drop(builtin, *_DISCOVERY, "avoid_builtin_multicast", "mutation_tries")
    elif localhost_peers is not None:
        # As rmw_fastrtps's create_participant does: it adds to what a profile of the user's has.
        lists[_SEARCHED].extend(builtin.findall(f"{_SEARCHED}/locator"))
        drop(builtin, *_DISCOVERY)
    descriptors = ET.SubElement(profiles, "transport_descriptors")
    chosen = ET.SubElement(rtps, "userTransports")
    for family in found:
        transport = f"{name}_{family.kind}"
        text(chosen, "transport_id", transport)
        made = ET.SubElement(descriptors, "transport_descriptor")
        text(made, "transport_id", transport)
        text(made, "type", _TYPES[family.kind])
        _describe(made, family, is_local=localhost_peers is not None)
        never_waits = non_blocking_send or any(url.non_blocking_send for url in family.urls)
        if family.kind.is_udp and never_waits:
            text(made, "non_blocking_send", "true")
        if family.kind.is_udp:
            _list_udp(lists, family, localhost_peers)
        elif family.kind.is_tcp:
            _list_tcp(lists, family, participant_ports(domain_id, 0).discovery_unicast)
    text(rtps, "useBuiltinTransports", "false")
    _add_data(rtps, found, lists)
    multicast = localhost_peers is None and all(url.multicast for url in urls)
    is_served = any(url.server for url in urls)
    if is_served:
        _add_servers(child(builtin, "discovery_config"), urls, super_client=super_client)
        lists[_SEARCHED].clear()
    elif not multicast and localhost_peers is None:
        text(builtin, "avoid_builtin_multicast", "true")
    _add_discovery(builtin, found, lists, multicast=multicast and not is_served)
    if not len(builtin):
        rtps.remove(builtin)


def _describe(made: ET.Element, family: UrlTransport, *, is_local: bool) -> None:
    """Add to a transport's description what its URLs say."""
    if family.kind.is_udp:
        for tag, option in (("TTL", "ttl"), ("output_port", "output_port")):
            values = [getattr(url, option) for url in family.urls]
            if given := [each for each in values if each is not None]:
                text(made, tag, str(given[0]))
    if family.kind.is_network and (family.urls or is_local):
        wide = is_local or any(peer.port is None for peer in family.peers)
        range_ = LOCALHOST_PEERS_RANGE if wide and family.kind.is_udp else 1
        text(made, "maxInitialPeersRange", str(range_))
    if family.interfaces:
        allowed = ET.SubElement(made, "interfaceWhiteList")
        for each in family.interfaces:
            text(allowed, "address" if parse_address(each) else "interface", each)
    if family.kind.is_tcp:
        # Fast DDS 2.14 dials first and says then which port it wants inside the connection; an
        # answer to the former that comes in between leaves the connection unused for good. A
        # SCHED_BATCH thread does not overtake (sched(7)), and needs no privilege.
        for tag, policy in (
            ("accept_thread", os.SCHED_BATCH),
            ("default_reception_threads", os.SCHED_OTHER),
        ):
            text(ET.SubElement(made, tag), "scheduling_policy", str(policy))
        for port in [url.port for url in family.urls if url.port][:1]:
            text(ET.SubElement(made, "listening_ports"), "port", str(port))


def _list_udp(
    lists: Mapping[str, ET.Element], family: UrlTransport, localhost_peers: tuple[str, ...] | None
) -> None:
    """List where a UDP transport's data and discovery arrive, and where others are looked for."""
    kind = family.kind
    own = [url for url in family.urls if not url.transport.is_group]
    # Readers of a group also need an address of their own: one that is alone is sent to there, and
    # what a reliable writer repeats.
    for address, port in [(url.address, url.port) for url in own] or [("", None)]:
        _locator(lists[_UNICAST], kind, address, port=port)
    for url in family.urls:
        if url.transport.is_group:
            _locator(lists[_GROUPS], kind, url.address, port=url.port)
    # A locator without address and port means "any" and keeps multicast from being added.
    for address in dict.fromkeys(url.address for url in own) or ("",):
        _locator(lists[_DISCOVERY_UNICAST], kind, address, port=family.metatraffic_port)
    _locator(lists[_DISCOVERY_GROUPS], kind, DISCOVERY_GROUP[kind])
    for peer in family.peers:
        _locator(lists[_SEARCHED], kind, peer.address, port=peer.port)
    for address in () if localhost_peers is None else (*localhost_peers, kind.loopback):
        parsed = parse_address(address)  # None of a name, which may be of any family
        if parsed is None or parsed.version == kind.ip_version:
            _locator(lists[_SEARCHED], kind, address)


def _list_tcp(lists: Mapping[str, ET.Element], family: UrlTransport, logical: int) -> None:
    """List the same of a TCP transport.

    Its data arrive at discovery's port inside a connection: Fast DDS may lose the request for
    another one, and who was discovered over TCP is then reached by data, too.
    """
    for url in family.urls:
        for tag in (_UNICAST, _DISCOVERY_UNICAST):
            _locator(lists[tag], family.kind, url.address, physical=url.port, port=logical)
    for peer in family.peers:
        _locator(lists[_SEARCHED], family.kind, peer.address, physical=peer.port)


def _locator(
    parent: ET.Element,
    kind: Medium,
    address: str,
    *,
    port: int | None = None,
    physical: int | None = None,
) -> None:
    """Add a locator to a list.

    Args:
        parent: the list.
        kind: UDPV4, UDPV6 or TCPV4.
        address: empty for any.
        port: None for the well-known one; of TCP the port inside the connection.
        physical: TCP's port that is listened on; None for the transport's.
    """
    element = ET.SubElement(ET.SubElement(parent, "locator"), kind.value)
    for tag, value in (("address", address), ("physical_port", physical), ("port", port)):
        if value:
            text(element, tag, str(value))


def _add_data(
    rtps: ET.Element, found: Sequence[UrlTransport], lists: Mapping[str, ET.Element]
) -> None:
    """Say where data arrives, if any of it is fixed: then Fast DDS adds nothing by itself."""
    has_port = any(url.port and url.transport.is_udp for family in found for url in family.urls)
    has_tcp = any(family.kind.is_tcp for family in found)
    is_network = all(family.kind.is_network for family in found)
    if has_port or (has_tcp and is_network):
        rtps.extend(each for tag in _DATA if len(each := lists[tag]))


def _add_discovery(
    builtin: ET.Element,
    found: Sequence[UrlTransport],
    lists: Mapping[str, ET.Element],
    *,
    multicast: bool,
) -> None:
    """Say where discovery arrives, if Fast DDS would not do as asked by itself, and goes to."""
    udp = [family for family in found if family.kind.is_udp]
    is_fixed = any(family.metatraffic_port for family in udp)
    if is_fixed or all(family.kind.is_tcp for family in found) or (udp and not multicast):
        builtin.append(lists[_DISCOVERY_UNICAST])
        if udp and multicast:  # an empty list would be refused
            builtin.append(lists[_DISCOVERY_GROUPS])
    if len(searched := lists[_SEARCHED]):
        if multicast:
            # Named peers replace the groups by which Fast DDS otherwise announces.
            searched.extend(lists[_DISCOVERY_GROUPS])
        builtin.append(searched)
    if all(family.kind.is_udp and _all_ports_fixed(family) for family in found):
        # Else Fast DDS would take other ports for busy ones, and no peer would look there.
        text(builtin, "mutation_tries", "0")


def _all_ports_fixed(family: UrlTransport) -> bool:
    ports = [url.port for url in family.urls if not url.transport.is_group]
    return bool(family.metatraffic_port and ports and all(ports))


def _interfaces(urls: Sequence[ConnectionUrl]) -> tuple[str, ...]:
    """Return what a transport of these URLs is bound to; empty for everything."""
    bound = {url: url.interfaces or _own_address(url) for url in urls}
    some = [url for url in urls if bound[url]]
    free = [url for url in urls if not bound[url]]
    if some and not all(url.transport.is_group for url in free):
        raise MiddlewareError(
            f"cannot use {str(free[0])!r} on all interfaces and {str(some[0])!r} on some: one "
            "participant has one transport for both",
            hint="give both an address or interface=",
        )
    return tuple(dict.fromkeys(each for url in some for each in bound[url]))


def _own_address(url: ConnectionUrl) -> tuple[str, ...]:
    is_any = not url.address or is_wildcard(url.address)
    return () if is_any or url.transport.is_group else (url.address,)


def _check(found: Sequence[UrlTransport], urls: Sequence[ConnectionUrl]) -> None:
    for family in found:
        one_port = ("port",) if family.kind.is_tcp else ()
        for option in ("ttl", "output_port", "metatraffic_port", *one_port):
            values = {getattr(url, option): url for url in family.urls}
            values.pop(None, None)
            if len(values) > 1:
                spelt = " and ".join(repr(str(url)) for url in values.values())
                what = "TCP port" if option == "port" else option
                raise MiddlewareError(
                    f"cannot use {spelt} together: one participant has one {what}",
                    hint="give them to different connections",
                )
    fixed = [url for url in urls if url.transport.is_udp and url.port]
    if fixed and not all(family.kind.is_network for family in found):
        raise MiddlewareError(
            f"cannot use 'shm://' beside {str(fixed[0])!r}: a profile with fixed ports cannot say "
            "where shared memory listens, so it would not",
            hint="leave shm:// or the port out",
        )
    servers = [url for url in urls if url.server]
    peers = [url for url in urls if url.peers]
    if servers and peers:
        raise MiddlewareError(
            f"cannot look for peers {str(peers[0])!r} as a client of {str(servers[0])!r}: a client "
            "of a discovery server finds nobody else",
            hint="leave peer= or server= out",
        )


def _add_servers(config: ET.Element, urls: Sequence[ConnectionUrl], *, super_client: bool) -> None:
    drop(config, "discoveryProtocol", "discoveryServersList")
    text(config, "discoveryProtocol", "SUPER_CLIENT" if super_client else "CLIENT")
    servers = ET.SubElement(config, "discoveryServersList")
    for url in urls:
        for index, server in enumerate(url.server):
            listened = servers
            if installed().names_servers:
                octets = url.server_prefix.split(".")
                server_id = int(octets[_SERVER_ID_BYTE], 16) + index
                octets[_SERVER_ID_BYTE] = f"{server_id & 0xFF:02x}"
                remote = ET.SubElement(servers, "RemoteServer", prefix=".".join(octets))
                listened = ET.SubElement(remote, "metatrafficUnicastLocatorList")
            # A server's logical port is its physical one.
            physical = server.port if url.transport.is_tcp else None
            kind = udp_to(url.address) if url.transport.is_group else url.transport
            _locator(listened, kind, server.address, port=server.port, physical=physical)
