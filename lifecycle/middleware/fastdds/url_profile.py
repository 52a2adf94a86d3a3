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
from collections.abc import Iterable, Mapping, Sequence
from xml.etree import ElementTree as ET

from lifecycle import dataclasses
from lifecycle.errors import MiddlewareError
from lifecycle.middleware.fastdds.profiles import child as _child
from lifecycle.middleware.fastdds.profiles import locator as _locator
from lifecycle.middleware.fastdds.profiles import tcp_locator as _tcp_locator
from lifecycle.middleware.fastdds.profiles import text as _text
from lifecycle.middleware.versions import installed
from lifecycle.network.connection_url import ConnectionUrl, Peer
from lifecycle.network.medium import Medium, udp_to
from lifecycle.network.ports import LOCALHOST_PEERS_RANGE, participant_ports

DISCOVERY_GROUP = {Medium.UDPV4: "239.255.0.1", Medium.UDPV6: "ff1e::ffff:efff:1"}
"""Where Fast DDS 2.14 announces participants by multicast."""

TYPES = {Medium.UDPV4: "UDPv4", Medium.UDPV6: "UDPv6", Medium.TCPV4: "TCPv4", Medium.SHM: "SHM"}
"""What a profile calls the transports."""

_ANNOUNCED_NS = 500_000_000
"""A participant announces itself this often where it cannot be probed.

Over TCP Fast DDS 2.14 sends nothing while a connection or a port in it is being agreed on, and
dials again only when there is something to send: what gets lost so comes with the next
announcement, or with the one after it, which by default is 3 s later.
"""

_SERVER_ID_BYTE = 2
"""`fast-discovery-server -i ID` writes ID into the third byte of its GUID prefix."""

_UNICAST, _GROUPS = _DATA = ("defaultUnicastLocatorList", "defaultMulticastLocatorList")
_DISCOVERY_UNICAST, _DISCOVERY_GROUPS, _SEARCHED, *_ = _DISCOVERY = (
    "metatrafficUnicastLocatorList",
    "metatrafficMulticastLocatorList",
    "initialPeersList",
    "avoid_builtin_multicast",
    "mutation_tries",
)


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
        or (url.address and not _is_group(url))
        for url in udp
    )


def transport_of(url: ConnectionUrl) -> Medium:
    """Return the kind of transport that a URL is served by; a group's is that of its address."""
    return udp_to(url.address) if _is_group(url) else url.transport


def may_be(address: str, kind: Medium) -> bool:
    """Whether a peer can be reached by a family; a name may be, by any."""
    version = _ip_version(address)
    return version is None or version == kind.ip_version


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
    found = families(urls)
    builtin = _child(rtps, "builtin")
    for parent, tags in ((rtps, _DATA), (builtin, _DISCOVERY)):
        for each in [each for each in parent if each.tag in tags]:
            parent.remove(each)
    lists = {tag: ET.Element(tag) for tag in (*_DATA, *_DISCOVERY)}
    descriptors = ET.SubElement(profiles, "transport_descriptors")
    chosen = ET.SubElement(rtps, "userTransports")
    for family in found:
        descriptors.append(
            descriptor(
                name,
                family,
                non_blocking=non_blocking_send or any(url.non_blocking_send for url in family.urls),
                open_peers=localhost_peers is not None,
            )
        )
        _text(chosen, "transport_id", f"{name}_{family.kind}")
        if family.udp:
            _list_udp(lists, family, localhost_peers)
        elif family.kind.is_tcp:
            _list_tcp(lists, family, participant_ports(domain_id, 0).discovery_unicast)
    _text(rtps, "useBuiltinTransports", "false")
    _add_data(rtps, found, lists)
    multicast = localhost_peers is None and all(url.multicast for url in urls)
    if any(url.server for url in urls):
        _add_servers(builtin, urls, super_client=super_client)
        lists.pop(_SEARCHED)
        _add_discovery(builtin, found, lists, multicast=False)
    else:
        _add_discovery(builtin, found, lists, multicast=multicast)
        if not multicast and localhost_peers is None:
            _text(builtin, "avoid_builtin_multicast", "true")


def descriptor(
    name: str, family: UrlTransport, *, non_blocking: bool, open_peers: bool
) -> ET.Element:
    """Return the description of a transport.

    Args:
        name: prefix of its name.
        family: what it is; without URLs, as Fast DDS has it by default.
        non_blocking: what finds a socket's buffer full is dropped, if it is UDP.
        open_peers: participants are looked for at each well-known port of a peer.
    """
    made = ET.Element("transport_descriptor")
    _text(made, "transport_id", f"{name}_{family.kind}")
    _text(made, "type", TYPES[family.kind])
    if family.udp:
        ttl = next((url.ttl for url in family.urls if url.ttl is not None), None)
        if ttl is not None:
            _text(made, "TTL", str(ttl))
        if family.output_port is not None:
            _text(made, "output_port", str(family.output_port))
        if non_blocking:
            _text(made, "non_blocking_send", "true")
    if family.kind.is_network:
        wide = open_peers or any(peer.port is None for peer in family.peers)
        range_ = LOCALHOST_PEERS_RANGE if wide and family.udp else 1
        if family.urls or open_peers:
            _text(made, "maxInitialPeersRange", str(range_))
    if family.interfaces:
        allowed = ET.SubElement(made, "interfaceWhiteList")
        for each in family.interfaces:
            _text(allowed, "address" if _ip_version(each) else "interface", each)
    if family.kind.is_tcp:
        # Fast DDS 2.14 dials first and says then which port it wants inside the connection; an
        # answer to the former that comes in between leaves the connection unused for good. A
        # SCHED_BATCH thread does not overtake (sched(7)), and needs no privilege.
        for tag, policy in (
            ("accept_thread", os.SCHED_BATCH),
            ("default_reception_threads", os.SCHED_OTHER),
        ):
            _text(ET.SubElement(made, tag), "scheduling_policy", str(policy))
        ports = [url.port for url in family.urls if url.port]
        if ports:
            _text(ET.SubElement(made, "listening_ports"), "port", str(ports[0]))
    return made


def _list_udp(
    lists: Mapping[str, ET.Element], family: UrlTransport, localhost_peers: tuple[str, ...] | None
) -> None:
    """List where a UDP transport's data and discovery arrive, and where others are looked for."""
    kind = family.kind
    own = [url for url in family.urls if not _is_group(url)]
    # Readers of a group also need an address of their own: one that is alone is sent to there, and
    # what a reliable writer repeats.
    for address, port in [(url.address, url.port) for url in own] or [("", None)]:
        _locator(lists[_UNICAST], kind, address, port)
    for url in family.urls:
        if _is_group(url):
            _locator(lists[_GROUPS], kind, url.address, url.port)
    for address in dict.fromkeys(url.address for url in own) or ("",):
        _locator(lists[_DISCOVERY_UNICAST], kind, address, family.metatraffic_port)
    _locator(lists[_DISCOVERY_GROUPS], kind, DISCOVERY_GROUP[kind], None)
    for peer in family.peers:
        _locator(lists[_SEARCHED], kind, peer.address, peer.port)
    if localhost_peers is not None:
        for address in (*localhost_peers, kind.loopback):
            if may_be(address, kind):
                _locator(lists[_SEARCHED], kind, address, None)


def _list_tcp(lists: Mapping[str, ET.Element], family: UrlTransport, logical: int) -> None:
    """List the same of a TCP transport.

    Its data arrive at discovery's port inside a connection: Fast DDS may lose the request for
    another one, and who was discovered over TCP is then reached by data, too.
    """
    for url in family.urls:
        for tag in (_UNICAST, _DISCOVERY_UNICAST):
            _tcp_locator(lists[tag], family.kind, url.address, url.port, logical)
    for peer in family.peers:
        _tcp_locator(lists[_SEARCHED], family.kind, peer.address, peer.port, None)


def _add_data(
    rtps: ET.Element, found: Sequence[UrlTransport], lists: Mapping[str, ET.Element]
) -> None:
    """Say where data arrives, if any of it is fixed: then Fast DDS adds nothing by itself."""
    ports = any(
        url.port for family in found if family.udp for url in family.urls if not _is_group(url)
    )
    has_tcp = any(family.kind.is_tcp for family in found)
    is_network = all(family.kind.is_network for family in found)
    if ports or (has_tcp and is_network) or len(lists[_GROUPS]):
        rtps.extend(each for tag in _DATA if len(each := lists[tag]))


def _add_discovery(
    builtin: ET.Element,
    found: Sequence[UrlTransport],
    lists: Mapping[str, ET.Element],
    *,
    multicast: bool,
) -> None:
    """Say where discovery arrives, if Fast DDS would not do as asked by itself, and goes to."""
    udp = [family for family in found if family.udp]
    is_fixed = any(family.metatraffic_port for family in udp)
    if is_fixed or all(family.kind.is_tcp for family in found) or (udp and not multicast):
        builtin.append(lists[_DISCOVERY_UNICAST])
        if udp and multicast:  # an empty list would be refused
            builtin.append(lists[_DISCOVERY_GROUPS])
    searched = lists.get(_SEARCHED)
    if searched is not None and len(searched):
        if multicast:
            # Named peers replace the groups by which Fast DDS otherwise announces.
            searched.extend(lists[_DISCOVERY_GROUPS])
        builtin.append(searched)
    if len(udp) < len(found):
        config = _child(builtin, "discovery_config")
        if config.find("leaseAnnouncement") is None:  # the user's own profile may say it
            _text(ET.SubElement(config, "leaseAnnouncement"), "nanosec", str(_ANNOUNCED_NS))
    if all(family.udp and _all_ports_fixed(family) for family in found):
        # Else Fast DDS would take other ports for busy ones, and no peer would look there.
        _text(builtin, "mutation_tries", "0")


def _interfaces(urls: Sequence[ConnectionUrl]) -> tuple[str, ...]:
    """Return what a transport of these URLs is bound to; empty for everything."""
    free = [url for url in urls if not _bound_to(url)]
    bound = [url for url in urls if _bound_to(url)]
    if free and bound and not all(_is_group(url) for url in free):
        raise MiddlewareError(
            f"cannot use {str(free[0])!r} on all interfaces and {str(bound[0])!r} on some: one "
            "participant has one transport for both",
            hint="give both an address or interface=",
        )
    return tuple(dict.fromkeys(each for url in bound for each in _bound_to(url)))


def _bound_to(url: ConnectionUrl) -> tuple[str, ...]:
    if url.interfaces:
        return url.interfaces
    if _is_group(url) or not url.address or ipaddress.ip_address(url.address).is_unspecified:
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


def _add_servers(builtin: ET.Element, urls: Sequence[ConnectionUrl], *, super_client: bool) -> None:
    config = _child(builtin, "discovery_config")
    for tag in ("discoveryProtocol", "discoveryServersList"):
        for element in config.findall(tag):
            config.remove(element)
    _text(config, "discoveryProtocol", "SUPER_CLIENT" if super_client else "CLIENT")
    servers = ET.SubElement(config, "discoveryServersList")
    for url in urls:
        for index, server in enumerate(url.server):
            listened = servers
            if installed().names_servers:
                prefix = _counted(url.server_prefix, index)
                remote = ET.SubElement(servers, "RemoteServer", prefix=prefix)
                listened = ET.SubElement(remote, "metatrafficUnicastLocatorList")
            if url.transport.is_tcp:
                # A server's logical port is its physical one.
                _tcp_locator(listened, url.transport, server.address, server.port, server.port)
            else:
                _locator(listened, transport_of(url), server.address, server.port)


def _counted(prefix: str, index: int) -> str:
    octets = prefix.split(".")
    octets[_SERVER_ID_BYTE] = f"{(int(octets[_SERVER_ID_BYTE], 16) + index) & 0xFF:02x}"
    return ".".join(octets)


def _is_group(url: ConnectionUrl) -> bool:
    return url.transport.is_group


def _all_ports_fixed(family: UrlTransport) -> bool:
    ports = [url.port for url in family.urls if not _is_group(url)]
    return bool(family.metatraffic_port and ports and all(ports))


def _ip_version(address: str) -> int | None:
    """Return 4 or 6; None for a name."""
    try:
        return ipaddress.ip_address(address).version
    except ValueError:
        return None
