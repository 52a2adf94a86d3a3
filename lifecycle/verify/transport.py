"""Which transport carries a flow. Pure.

Owns: the judgement from process, machine and NFEs, by the definitions of `lifecycle.network`. An
NFE list says what an endpoint could use, not what is used; what Fast DDS does with it is known, and
is written down here.

Fast DDS passes data on inside a process without any transport (measured with 2.14: UDP only, 50 MB
published, next to nothing on the interface), and between processes of one host it prefers shared
memory to any IP transport that both ends have. To subscriptions that listen at one multicast group
it sends one datagram to the group; to one that listens there alone, the same one datagram by
unicast: both count as multicast.
"""

from __future__ import annotations

from collections.abc import Sequence

from lifecycle.network.connection_url import ConnectionUrlError, parse
from lifecycle.network.medium import Medium
from lifecycle.network.nfe import (
    InternetProtocol,
    NetworkFlowEndpoint,
    TransportProtocol,
    is_ip,
    is_multicast,
)
from lifecycle.verify.observation import Identity, NodeConfiguration
from lifecycle.verify.view import Actual, FlowView

NONE = "none"
UNKNOWN = "unknown"

_ANY_PORT = 0
"""Of the NFE made from a URL: no port distinguishes one transport from another."""


def effective_transport(flow: FlowView) -> str:
    """Return what carries a planned flow, as `carrier` says."""
    source, destination = (each.configuration for each in flow.nodes)
    return carrier(
        _ways(source, flow.publishers),
        _ways(destination, flow.subscriptions),
        None if source is None else source.identity,
        None if destination is None else destination.identity,
    )


def _ways(
    configuration: NodeConfiguration | None, ends: Sequence[Actual]
) -> tuple[NetworkFlowEndpoint, ...]:
    """Return the NFEs of one side, and what it was connected to where they do not show it.

    rmw_fastrtps lists no NFE of a TCP transport at a publisher.
    """
    connections = (
        {each.name: each.urls for each in configuration.connections} if configuration else {}
    )
    found: list[NetworkFlowEndpoint] = []
    for end in ends:
        if end.report is None or end.report.nfes is None:
            continue
        found += end.report.nfes
        listed = {each.transport_protocol for each in end.report.nfes}
        urls = connections.get(end.report.connection, ()) if end.report.mapped else ()
        found += [
            each
            for each in map(_as_nfe, urls)
            if each is not None
            and (not listed or (_is_tcp(each) and TransportProtocol.TCP not in listed))
        ]
    return tuple(found)


def _is_tcp(nfe: NetworkFlowEndpoint) -> bool:
    return nfe.transport_protocol is TransportProtocol.TCP


def _as_nfe(text: str) -> NetworkFlowEndpoint | None:
    """Return a connection URL's network part as an NFE; None if it has none."""
    try:
        url = parse(text)
    except ConnectionUrlError:
        return None
    if not url.transport.is_network:
        return NetworkFlowEndpoint(
            transport_protocol=TransportProtocol.UNKNOWN,
            internet_protocol=InternetProtocol.UNKNOWN,
            transport_port=_ANY_PORT,
        )
    ipv6 = url.transport.ip_version == 6 or ":" in url.address
    return NetworkFlowEndpoint(
        transport_protocol=TransportProtocol.TCP if url.transport.is_tcp else TransportProtocol.UDP,
        internet_protocol=InternetProtocol.IPV6 if ipv6 else InternetProtocol.IPV4,
        transport_port=_ANY_PORT,
        internet_address=url.address or url.transport.any_address,
    )


def carrier(
    source: Sequence[NetworkFlowEndpoint],
    destination: Sequence[NetworkFlowEndpoint],
    publisher: Identity | None,
    subscription: Identity | None,
) -> str:
    """Return what carries the data from a publisher to a subscription.

    Args:
        source: the publisher's NFEs; empty when not known.
        destination: the subscription's.
        publisher: identity of the publishing node; None when not known.
        subscription: likewise.

    Returns:
        `intraprocess`, `shm`, `udpm` if the destination listens at a group, or the first IP
        transport of it that the source has too, `udpv4`, `udpv6`, `tcpv4`, `tcpv6`; `none` if they
        have nothing in common, `unknown` if one side is not known.
    """
    if publisher is None or subscription is None:
        return UNKNOWN
    same_host = publisher.machine_id == subscription.machine_id
    if same_host and publisher.process_id == subscription.process_id:
        return Medium.INTRAPROCESS
    if not source or not destination:
        return UNKNOWN
    if same_host and _has_shared_memory(source) and _has_shared_memory(destination):
        return Medium.SHM
    leaving = {each.medium for each in source if is_ip(each)}
    groups = [each for each in destination if is_ip(each) and _is_group(each)]
    # A group has no router between here and another host: it is sent with a TTL of 0.
    if same_host and any(each.medium in leaving for each in groups):
        return Medium.UDPM
    arriving = (each.medium for each in destination if is_ip(each) and each not in groups)
    return next((each for each in arriving if each in leaving), NONE)


def _is_group(nfe: NetworkFlowEndpoint) -> bool:
    return nfe.transport_protocol is TransportProtocol.UDP and is_multicast(nfe.internet_address)


def _has_shared_memory(nfes: Sequence[NetworkFlowEndpoint]) -> bool:
    return any(
        each.transport_protocol is TransportProtocol.UNKNOWN and not each.internet_address
        for each in nfes
    )
