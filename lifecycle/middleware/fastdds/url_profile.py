"""Transports of a participant in its Fast DDS profile, with their locators and discovery.

Owns: the grouping of connection URLs into Fast DDS transports, and the XML of profiles' elements.
Must not import rclpy; reads no environment.

Two URLs of one family (IPv4 UDP and a group over IPv4) share one transport: with two of a kind Fast
DDS would send everything twice.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from typing import Any
from xml.etree import ElementTree as ET

import msgspec

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.versions import installed
from lifecycle.network.connection_url import ConnectionUrl, ConnectionUrlError, Peer, check_together
from lifecycle.network.medium import Medium
from lifecycle.network.nfe import parse_address
from lifecycle.network.ports import LOCALHOST_PEERS_RANGE, participant_ports

DISCOVERY_GROUP = {Medium.UDPV4: "239.255.0.1", Medium.UDPV6: "ff1e::ffff:efff:1"}
"""Where Fast DDS announces participants by multicast."""

_TYPES = {Medium.UDPV4: "UDPv4", Medium.UDPV6: "UDPv6", Medium.TCPV4: "TCPv4", Medium.SHM: "SHM"}
"""What a profile calls the transports."""

_DATA = ("defaultUnicastLocatorList", "defaultMulticastLocatorList")
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
    """

    kind: Medium
    urls: tuple[ConnectionUrl, ...] = ()

    @property
    def peers(self) -> tuple[Peer, ...]:
        """Who its URLs say is looked for, each once."""
        return tuple(dict.fromkeys(peer for url in self.urls for peer in url.peers))

    @property
    def interfaces(self) -> tuple[str, ...]:
        """Addresses or names that it is bound to; empty for all."""
        return tuple(dict.fromkeys(each for url in self.urls for each in url.bound))

    def option(self, name: str) -> Any:
        """Return the value of an option that it can have only once; None if no URL has it."""
        values = (getattr(url, name) for url in self.urls)
        return next((each for each in values if each is not None), None)


def families(urls: Sequence[ConnectionUrl]) -> tuple[UrlTransport, ...]:
    """Return the transports that a participant of these URLs has, in the order of the URLs.

    Raises:
        MiddlewareError: URLs that one participant cannot have together.
    """
    try:
        check_together(urls)
    except ConnectionUrlError as error:
        raise MiddlewareError(error.message, hint=error.hint) from error
    by_kind: dict[Medium, list[ConnectionUrl]] = {}
    for url in urls:
        by_kind.setdefault(url.family, []).append(url)
    return tuple(UrlTransport(kind=kind, urls=tuple(each)) for kind, each in by_kind.items())


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
        non_blocking_send: on every UDP transport.
        localhost_peers: see `participant_profile.profile`.
    """
    urls = [url for family in found for url in family.urls]
    udp = [family for family in found if family.kind.is_udp]
    tcp = [family for family in found if family.kind.is_tcp]
    builtin = child(rtps, "builtin")
    searched: list[ET.Element] = []
    if urls:
        drop(rtps, *_DATA)
        drop(builtin, *_DISCOVERY, "avoid_builtin_multicast", "mutation_tries")
    elif localhost_peers is not None:
        # As rmw_fastrtps's create_participant does: it adds to what a profile of the user's has.
        searched += builtin.findall(f"{_SEARCHED}/locator")
        drop(builtin, *_DISCOVERY)
    descriptors = ET.SubElement(profiles, "transport_descriptors")
    chosen = ET.SubElement(rtps, "userTransports")
    for family in found:
        made = _described(family, is_local=localhost_peers is not None)
        if family.kind.is_udp and non_blocking_send:
            put(made, "non_blocking_send", "true")
        put(made, "transport_id", f"{name}_{family.kind}")
        descriptors.append(made)
        ET.SubElement(chosen, "transport_id").text = f"{name}_{family.kind}"
        searched += _looked_for(family, localhost_peers)
    put(rtps, "useBuiltinTransports", "false")
    # Over TCP data arrive at discovery's port inside a connection: Fast DDS may lose the request
    # for another one, and who was discovered over TCP is then reached by data, too.
    logical = participant_ports(domain_id, 0).discovery_unicast
    inside = [
        _locator(each.kind, url.address, physical=url.port, port=logical)
        for each in tcp
        for url in each.urls
    ]
    is_network = len(tcp) + len(udp) == len(found)
    if any(url.port and url.transport.is_udp for url in urls) or (tcp and is_network):
        # Some of it is fixed: then Fast DDS adds nothing by itself.
        groups = [url for url in urls if url.transport.is_group]
        _list(rtps, _DATA[0], [*inside, *(at for each in udp for at in _own(each))])
        _list(rtps, _DATA[1], [_locator(url.family, url.address, port=url.port) for url in groups])
    multicast = localhost_peers is None and all(url.multicast for url in urls)
    if any(url.server for url in urls):
        _add_servers(child(builtin, "discovery_config"), urls)
        searched, multicast = [], False
    elif not multicast and localhost_peers is None:
        put(builtin, "avoid_builtin_multicast", "true")
    groups_of_all = [_locator(each.kind, DISCOVERY_GROUP[each.kind]) for each in udp if multicast]
    is_fixed = any(family.option("metatraffic_port") for family in udp)
    if is_fixed or len(tcp) == len(found) or (udp and not multicast):
        # Fast DDS would not do as asked by itself.
        received_at = [*inside, *(at for each in udp for at in _own(each, of_discovery=True))]
        _list(builtin, _DISCOVERY_UNICAST, received_at)
        _list(builtin, _DISCOVERY_GROUPS, groups_of_all)
    if searched:
        # Named peers replace the groups by which Fast DDS otherwise announces.
        _list(builtin, _SEARCHED, [*searched, *groups_of_all])
    if all(map(_has_fixed_ports, found)):
        # Else Fast DDS would take other ports for busy ones, and no peer would look there.
        put(builtin, "mutation_tries", 0)
    if not len(builtin):
        rtps.remove(builtin)


def _has_fixed_ports(family: UrlTransport) -> bool:
    ports = [url.port for url in family.urls if not url.transport.is_group]
    is_fixed = family.kind.is_udp and family.option("metatraffic_port")
    return bool(is_fixed and ports) and all(ports)


def _described(family: UrlTransport, *, is_local: bool) -> ET.Element:
    """Return a transport's description as its URLs say."""
    made = ET.Element("transport_descriptor")
    put(made, "type", _TYPES[family.kind])
    if family.kind.is_udp:
        for tag, option in (("TTL", "ttl"), ("output_port", "output_port")):
            if (value := family.option(option)) is not None:
                put(made, tag, value)
    if family.kind.is_network and (family.urls or is_local):
        wide = is_local or any(peer.port is None for peer in family.peers)
        range_ = LOCALHOST_PEERS_RANGE if wide and family.kind.is_udp else 1
        put(made, "maxInitialPeersRange", range_)
    if family.interfaces:
        allowed = child(made, "interfaceWhiteList")
        for each in family.interfaces:
            tag = "address" if parse_address(each) else "interface"
            ET.SubElement(allowed, tag).text = each
    if family.kind.is_tcp:
        # Fast DDS 2.14 dials first and says then which port it wants inside the connection; an
        # answer to the former that comes in between leaves the connection unused for good. A
        # SCHED_BATCH thread does not overtake (sched(7)), and needs no privilege.
        put(made, "accept_thread/scheduling_policy", os.SCHED_BATCH)
        put(made, "default_reception_threads/scheduling_policy", os.SCHED_OTHER)
        if port := family.option("port"):
            put(made, "listening_ports/port", port)
    return made


def _own(family: UrlTransport, *, of_discovery: bool = False) -> Iterator[ET.Element]:
    """Yield where data, or discovery, arrive over UDP.

    Readers of a group also need an address of their own: one that is alone is sent to there, and
    what a reliable writer repeats. A locator without address and port means "any" and keeps
    multicast from being added.
    """
    own = [url for url in family.urls if not url.transport.is_group]
    port = family.option("metatraffic_port")
    at = [(url.address, port if of_discovery else url.port) for url in own]
    for address, number in dict.fromkeys(at) or [("", port if of_discovery else None)]:
        yield _locator(family.kind, address, port=number)


def _looked_for(
    family: UrlTransport, localhost_peers: tuple[str, ...] | None
) -> Iterator[ET.Element]:
    """Yield where others are looked for by a transport."""
    kind = family.kind
    for peer in family.peers:
        if kind.is_tcp:
            yield _locator(kind, peer.address, physical=peer.port)
        else:
            yield _locator(kind, peer.address, port=peer.port)
    if localhost_peers is None or not kind.is_udp:
        return
    for address in (*localhost_peers, kind.loopback):
        parsed = parse_address(address)  # None of a name, which may be of any family
        if parsed is None or parsed.version == kind.ip_version:
            yield _locator(kind, address)


def _locator(
    kind: Medium, address: str, *, port: int | None = None, physical: int | None = None
) -> ET.Element:
    """Return a locator; no address is any, no port the well-known one, of TCP the one inside."""
    locator = ET.Element("locator")
    element = ET.SubElement(locator, kind.value)
    for tag, value in (("address", address), ("physical_port", physical), ("port", port)):
        if value:
            put(element, tag, value)
    return locator


def _list(parent: ET.Element, tag: str, locators: Sequence[ET.Element]) -> None:
    if locators:  # an empty list would be refused
        ET.SubElement(parent, tag).extend(locators)


def _add_servers(config: ET.Element, urls: Sequence[ConnectionUrl]) -> None:
    drop(config, "discoveryProtocol", "discoveryServersList")
    put(config, "discoveryProtocol", "CLIENT")
    servers = child(config, "discoveryServersList")
    for url in urls:
        for index, server in enumerate(url.server):
            listened = servers
            if installed().names_servers:
                # `fast-discovery-server -i ID` writes ID into the third byte.
                prefix = f"44.53.{index & 0xFF:02x}.5f.45.50.52.4f.53.49.4d.41"
                remote = ET.SubElement(servers, "RemoteServer", prefix=prefix)
                listened = child(remote, "metatrafficUnicastLocatorList")
            # A server's logical port is its physical one.
            physical = server.port if url.transport.is_tcp else None
            at = _locator(url.family, server.address, port=server.port, physical=physical)
            listened.append(at)


def child(parent: ET.Element, tag: str) -> ET.Element:
    """Return the first child of this name; made if there is none."""
    found = parent.find(tag)
    return ET.SubElement(parent, tag) if found is None else found


def drop(parent: ET.Element, *tags: str) -> None:
    """Remove the children of these names."""
    for each in [each for each in parent if each.tag in tags]:
        parent.remove(each)


def put(parent: ET.Element, path: str, content: object) -> None:
    """Set the text of an element by its path; the ones on the way are made if there are none."""
    for tag in path.split("/"):
        parent = child(parent, tag)
    parent.text = str(content)
