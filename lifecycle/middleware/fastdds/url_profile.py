"""Connection URLs as a Fast DDS participant profile: transports, locators and discovery.

Owns: a participant's transports and where its data arrives; where its discovery arrives, where it
is sent to, discovery servers, and how often the participant announces itself; the grouping of URLs
into Fast DDS transports, and which URLs one participant cannot have together. Must not import
rclpy; reads no environment.

Two URLs of one family (IPv4 UDP and a group over IPv4) share one transport: with two of a kind Fast
DDS would send everything twice.
"""

from __future__ import annotations

import ipaddress
import os
from collections.abc import Iterable, Sequence
from xml.etree import ElementTree as ET

from lifecycle import dataclasses
from lifecycle.errors import MiddlewareError
from lifecycle.middleware.fastdds.profiles import child as _child
from lifecycle.middleware.fastdds.profiles import locator as _locator
from lifecycle.middleware.fastdds.profiles import tcp_locator as _tcp_locator
from lifecycle.middleware.fastdds.profiles import text as _text
from lifecycle.network.connection_url import ConnectionUrl, Peer
from lifecycle.network.medium import Medium, udp_to
from lifecycle.network.ports import LOCALHOST_PEERS_RANGE, participant_ports


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class UrlTransport:
    """One transport of a participant: all URLs that it serves.

    Attributes:
        kind: UDPV4, UDPV6, TCPV4 or SHM.
        urls: at least one.
        interfaces: addresses or names that it is bound to; empty for all.
    """

    kind: Medium
    urls: tuple[ConnectionUrl, ...]
    interfaces: tuple[str, ...] = ()

    @property
    def udp(self) -> bool:
        """Whether it carries UDP, and so may use multicast."""
        return self.kind.is_udp

    @property
    def peers(self) -> tuple[Peer, ...]:
        """Who its URLs say is looked for, each once."""
        return tuple(dict.fromkeys(peer for url in self.urls for peer in url.peers))

    @property
    def metatraffic_port(self) -> int | None:
        """The port for discovery that its URLs name, if one does."""
        return next((url.metatraffic_port for url in self.urls if url.metatraffic_port), None)

    @property
    def output_port(self) -> int | None:
        """The port that its URLs say is sent from, if one does."""
        return next((url.output_port for url in self.urls if url.output_port), None)

    @property
    def unicast(self) -> tuple[ConnectionUrl, ...]:
        """Its URLs that are no groups."""
        return tuple(url for url in self.urls if not url.transport.is_group)

    @property
    def groups(self) -> tuple[ConnectionUrl, ...]:
        """Its URLs that are groups."""
        return tuple(url for url in self.urls if url.transport.is_group)


def families(urls: Sequence[ConnectionUrl]) -> tuple[UrlTransport, ...]:
    """Return the transports that a participant of these URLs has, in the order of the URLs.

    Raises:
        MiddlewareError: URLs that one participant cannot have together.
    """
    if not urls:
        return ()
    by_kind: dict[Medium, list[ConnectionUrl]] = {}
    for url in urls:
        by_kind.setdefault(transport_of(url), []).append(url)
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


def transport_of(url: ConnectionUrl) -> Medium:
    """Return the kind of transport that a URL is served by; a group's is that of its address."""
    return udp_to(url.address) if url.transport.is_group else url.transport


def _interfaces(urls: Sequence[ConnectionUrl]) -> tuple[str, ...]:
    """Return what a transport of these URLs is bound to; empty for everything."""
    found: dict[str, None] = {}
    free = [url for url in urls if not _bound_to(url)]
    bound = [url for url in urls if _bound_to(url)]
    if free and bound and not all(url.transport.is_group for url in free):
        raise MiddlewareError(
            f"cannot use {str(free[0])!r} on all interfaces and {str(bound[0])!r} on some: one "
            "participant has one transport for both",
            hint="give both an address or interface=",
        )
    for url in bound:
        found.update(dict.fromkeys(_bound_to(url)))
    return tuple(found)


def _bound_to(url: ConnectionUrl) -> tuple[str, ...]:
    if url.interfaces:
        return url.interfaces
    group = url.transport.is_group
    if group or not url.address or ipaddress.ip_address(url.address).is_unspecified:
        return ()
    return (url.address,)


def _check(found: Sequence[UrlTransport], urls: Sequence[ConnectionUrl]) -> None:
    for family in found:
        for option in ("ttl", "output_port", "metatraffic_port"):
            values = {getattr(url, option): url for url in family.urls}
            values.pop(None, None)
            if len(values) > 1:
                spelt = " and ".join(repr(str(url)) for url in values.values())
                raise MiddlewareError(
                    f"cannot use {spelt} together: one participant has one {option}",
                    hint="give them to different connections",
                )
        listening = [url for url in family.urls if url.port] if family.kind.is_tcp else []
        if len(listening) > 1:
            raise MiddlewareError(
                f"cannot listen on {str(listening[0])!r} and {str(listening[1])!r}: one "
                "participant has one TCP port",
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


DISCOVERY_GROUP = {Medium.UDPV4: "239.255.0.1", Medium.UDPV6: "ff1e::ffff:efff:1"}
"""Where Fast DDS 2.14 announces participants by multicast."""

ANNOUNCED_S = 0.5
"""A participant announces itself each so many seconds where it cannot be probed.

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
    found: Sequence[UrlTransport],
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
        super_client: receive everything from the discovery server, not only of what matches.
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
        # Else Fast DDS would take other ports for busy ones, and no peer would look there.
        _text(builtin, "mutation_tries", "0")


def _add_metatraffic(
    builtin: ET.Element, found: Sequence[UrlTransport], domain_id: int, *, multicast: bool
) -> None:
    """Say where discovery arrives, if Fast DDS would not do as asked by itself."""
    fixed = any(family.metatraffic_port for family in found)
    tcp_alone = all(family.kind.is_tcp for family in found)
    udp = any(family.udp for family in found)
    if not (fixed or tcp_alone or (udp and not multicast)):
        return
    unicast = ET.SubElement(builtin, "metatrafficUnicastLocatorList")
    for family in found:
        if family.udp:
            addresses = dict.fromkeys(url.address for url in family.unicast) or {"": None}
            for address in addresses:
                _locator(unicast, family.kind, address, family.metatraffic_port)
        elif family.kind.is_tcp:
            logical = participant_ports(domain_id, 0).discovery_unicast
            for url in family.urls:
                _tcp_locator(unicast, family.kind, url.address, url.port, logical)
    if multicast and udp:  # an empty list would be refused
        groups = ET.SubElement(builtin, "metatrafficMulticastLocatorList")
        for family in found:
            if family.udp:
                _locator(groups, family.kind, DISCOVERY_GROUP[family.kind], None)


def _add_peers(
    builtin: ET.Element,
    found: Sequence[UrlTransport],
    *,
    extra: Sequence[Peer] = (),
    loopback: bool = False,
    announce: bool = False,
) -> None:
    searched = ET.Element("initialPeersList")
    for family in found:
        for peer in family.peers:
            if family.kind.is_tcp:
                _tcp_locator(searched, family.kind, peer.address, peer.port, None)
            else:
                _locator(searched, family.kind, peer.address, peer.port)
        if family.udp:
            for peer in extra:
                if may_be(peer.address, family.kind):
                    _locator(searched, family.kind, peer.address, None)
            if loopback:
                _locator(searched, family.kind, family.kind.loopback, None)
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
            if url.transport.is_tcp:
                # A server's logical port is its physical one.
                _tcp_locator(listened, url.transport, server.address, server.port, server.port)
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


def _all_ports_fixed(found: Sequence[UrlTransport]) -> bool:
    # Shared memory has ports of its own, which must stay free to move.
    return all(
        family.udp
        and family.metatraffic_port
        and family.unicast
        and all(url.port for url in family.unicast)
        for family in found
    )


def may_be(address: str, kind: Medium) -> bool:
    """Whether a peer can be reached by a family; a name may be, by any."""
    try:
        version = ipaddress.ip_address(address).version
    except ValueError:
        return True
    return kind.ip_version == version


TYPES = {Medium.UDPV4: "UDPv4", Medium.UDPV6: "UDPv6", Medium.TCPV4: "TCPv4", Medium.SHM: "SHM"}


def add_urls(
    name: str,
    profiles: ET.Element,
    rtps: ET.Element,
    urls: Sequence[ConnectionUrl],
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
        rtps: the participant's; what it said of locators and discovery is replaced.
        urls: at least one.
        domain_id: 0–232, for TCP's logical ports.
        super_client: receive everything from the discovery server, not only of what matches.
        non_blocking_send: on every UDP transport, whatever its URLs say.
        localhost_peers: look for others on this host and on these only; for URLs that leave
            discovery open.

    Raises:
        MiddlewareError: URLs that one participant cannot have together.
    """
    transports = families(urls)
    descriptors = ET.SubElement(profiles, "transport_descriptors")
    chosen = ET.SubElement(rtps, "userTransports")
    for family in transports:
        descriptors.append(
            _descriptor(
                name,
                family,
                non_blocking=non_blocking_send or any(url.non_blocking_send for url in family.urls),
                open_peers=localhost_peers is not None,
            )
        )
        _text(chosen, "transport_id", f"{name}_{family.kind}")
    _text(rtps, "useBuiltinTransports", "false")
    builtin = _child(rtps, "builtin")
    for tag in ("defaultUnicastLocatorList", "defaultMulticastLocatorList"):
        for element in rtps.findall(tag):
            rtps.remove(element)
    _add_user_traffic(rtps, transports, domain_id)
    add_discovery(
        builtin,
        transports,
        urls,
        domain_id=domain_id,
        super_client=super_client,
        localhost_peers=localhost_peers,
    )


def _descriptor(
    name: str, family: UrlTransport, *, non_blocking: bool, open_peers: bool
) -> ET.Element:
    descriptor = ET.Element("transport_descriptor")
    _text(descriptor, "transport_id", f"{name}_{family.kind}")
    _text(descriptor, "type", TYPES[family.kind])
    if family.udp:
        ttl = next((url.ttl for url in family.urls if url.ttl is not None), None)
        if ttl is not None:
            _text(descriptor, "TTL", str(ttl))
        if family.output_port is not None:
            _text(descriptor, "output_port", str(family.output_port))
        if non_blocking:
            _text(descriptor, "non_blocking_send", "true")
    if family.kind.is_network:
        wide = open_peers or any(peer.port is None for peer in family.peers)
        range_ = LOCALHOST_PEERS_RANGE if wide and family.udp else 1
        _text(descriptor, "maxInitialPeersRange", str(range_))
    if family.interfaces:
        allowed = ET.SubElement(descriptor, "interfaceWhiteList")
        for each in family.interfaces:
            _text(allowed, "interface" if _is_name(each) else "address", each)
    if family.kind.is_tcp:
        _keep_dialling_whole(descriptor)
        ports = [url.port for url in family.urls if url.port]
        if ports:
            _text(ET.SubElement(descriptor, "listening_ports"), "port", str(ports[0]))
    return descriptor


def _keep_dialling_whole(descriptor: ET.Element) -> None:
    """Keep the thread that finishes a connection from overtaking the one that began it.

    Fast DDS 2.14 dials first and says then which port it wants inside the connection; if the answer
    to the former comes in between, the connection stays unused for good. A SCHED_BATCH
    thread does not overtake then (sched(7)), and needs no privilege.
    """
    for tag, policy in (
        ("accept_thread", os.SCHED_BATCH),
        ("default_reception_threads", os.SCHED_OTHER),
    ):
        _text(ET.SubElement(descriptor, tag), "scheduling_policy", str(policy))


def _add_user_traffic(rtps: ET.Element, found: Sequence[UrlTransport], domain_id: int) -> None:
    """Say where data arrives, if any of it is fixed: then Fast DDS adds nothing by itself."""
    groups = [(family, url) for family in found for url in family.groups]
    ports = any(url.port for family in found if family.udp for url in family.unicast)
    with_tcp = any(family.kind.is_tcp for family in found)
    if not groups and not ports and (not with_tcp or not all(f.kind.is_network for f in found)):
        return
    unicast = ET.SubElement(rtps, "defaultUnicastLocatorList")
    for family in found:
        for url in family.unicast:
            if family.udp:
                _locator(unicast, family.kind, url.address, url.port)
            elif family.kind.is_tcp:
                # As discovery: one request for a port inside a connection, which Fast DDS may lose.
                # Who was discovered over TCP is then reached by data, too.
                logical = participant_ports(domain_id, 0).discovery_unicast
                _tcp_locator(unicast, family.kind, url.address, url.port, logical)
        if family.udp and not family.unicast:
            # Readers of a group also need an address of their own: one that is alone is sent to
            # there, and what a reliable writer repeats.
            _locator(unicast, family.kind, "", None)
    if groups:
        multicast = ET.SubElement(rtps, "defaultMulticastLocatorList")
        for family, url in groups:
            _locator(multicast, family.kind, url.address, url.port)


def _is_name(text: str) -> bool:
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return True
    return False
