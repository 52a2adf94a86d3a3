"""What connection URLs become in a Fast DDS participant profile.

Owns: a participant's transports and where its data arrives. Who is grouped into which transport is
`url_families`, discovery is `url_discovery`. Must not import rclpy; reads no environment.
"""

from __future__ import annotations

import ipaddress
import os
from collections.abc import Sequence
from xml.etree import ElementTree as ET

from lifecycle.middleware.fastdds.profile_xml import child as _child
from lifecycle.middleware.fastdds.profile_xml import locator as _locator
from lifecycle.middleware.fastdds.profile_xml import tcp_locator as _tcp_locator
from lifecycle.middleware.fastdds.profile_xml import text as _text
from lifecycle.middleware.fastdds.url_discovery import DISCOVERY_GROUP, add_discovery
from lifecycle.middleware.fastdds.url_families import (
    LOOPBACK,
    SHM,
    TCPV4,
    UDPV4,
    UDPV6,
    Family,
    families,
    leaves_discovery_open,
)
from lifecycle.network.connection_url import ConnectionUrl
from lifecycle.network.ports import participant_ports

__all__ = [
    "DISCOVERY_GROUP",
    "LOCALHOST_PEERS_RANGE",
    "LOOPBACK",
    "SHM",
    "TCPV4",
    "UDPV4",
    "UDPV6",
    "Family",
    "add_urls",
    "families",
    "leaves_discovery_open",
]

LOCALHOST_PEERS_RANGE = 32
"""Participants looked for on a peer without a port; rmw_fastrtps's own number for LOCALHOST."""

_TYPES = {UDPV4: "UDPv4", UDPV6: "UDPv6", TCPV4: "TCPv4", SHM: "SHM"}


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
        super_client: be told of everything by the discovery server, not only of what matches.
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


def _descriptor(name: str, family: Family, *, non_blocking: bool, open_peers: bool) -> ET.Element:
    descriptor = ET.Element("transport_descriptor")
    _text(descriptor, "transport_id", f"{name}_{family.kind}")
    _text(descriptor, "type", _TYPES[family.kind])
    if family.udp:
        ttl = next((url.ttl for url in family.urls if url.ttl is not None), None)
        if ttl is not None:
            _text(descriptor, "TTL", str(ttl))
        output = next((url.output_port for url in family.urls if url.output_port), None)
        if output is not None:
            _text(descriptor, "output_port", str(output))
        if non_blocking:
            _text(descriptor, "non_blocking_send", "true")
    if family.kind != SHM:
        peers = [peer for url in family.urls for peer in url.peers]
        wide = open_peers or any(peer.port is None for peer in peers)
        range_ = LOCALHOST_PEERS_RANGE if wide and family.udp else 1
        _text(descriptor, "maxInitialPeersRange", str(range_))
    if family.interfaces:
        allowed = ET.SubElement(descriptor, "interfaceWhiteList")
        for each in family.interfaces:
            is_name = _is_name(each)
            _text(allowed, "interface" if is_name else "address", each)
    if family.kind == TCPV4:
        _keep_dialling_whole(descriptor)
        ports = [url.port for url in family.urls if url.port]
        if ports:
            _text(ET.SubElement(descriptor, "listening_ports"), "port", str(ports[0]))
    return descriptor


def _keep_dialling_whole(descriptor: ET.Element) -> None:
    """Keep the thread that finishes a connection from overtaking the one that began it.

    Fast DDS 2.14 dials first and says then which port it wants inside the connection. If the answer
    to the former comes in between, the connection stays unused for good: nothing is sent, nothing
    closed (TCPTransportInterface::CreateInitialConnect, RTCPMessageManager::processRTCPMessage). On
    a busy machine the thread that it wakes takes its processor over just then; a SCHED_BATCH thread
    does not (sched(7)), and needs no privilege. Threads that receive are as always.
    """
    for tag, policy in (
        ("accept_thread", os.SCHED_BATCH),
        ("default_reception_threads", os.SCHED_OTHER),
    ):
        _text(ET.SubElement(descriptor, tag), "scheduling_policy", str(policy))


def _add_user_traffic(rtps: ET.Element, found: Sequence[Family], domain_id: int) -> None:
    """Say where data arrives, if any of it is fixed: then Fast DDS adds nothing by itself."""
    groups = [(family, url) for family in found for url in family.groups]
    ports = any(url.port for family in found if family.udp for url in family.unicast)
    with_tcp = any(family.kind == TCPV4 for family in found)
    if not groups and not ports and (not with_tcp or any(f.kind == SHM for f in found)):
        return
    unicast = ET.SubElement(rtps, "defaultUnicastLocatorList")
    for family in found:
        for url in family.unicast:
            if family.udp:
                _locator(unicast, family.kind, url.address, url.port)
            elif family.kind == TCPV4:
                logical = participant_ports(domain_id, 0).user_unicast
                _tcp_locator(unicast, url.address, url.port, logical)
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
