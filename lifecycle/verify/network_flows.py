"""Which endpoints have unique network flow endpoints, and which transport carries a flow. Pure.

For uniqueness the endpoints that nodes report are compared. An endpoint that no node reports lives
in another process, and it cannot share one of these NFEs: a UDP or TCP port belongs to one process
of a host (bind(2), EADDRINUSE), and another host has other addresses. So unknown NFEs make an
answer unknown only inside one process. Where the manifest declares the address of a machine, the
NFEs on that address are judged: it is by this one that flows between machines go.

An NFE list says what an endpoint could use, not what is used. Fast DDS passes data on inside a
process without any transport, and between processes of one host it prefers shared memory to any IP
transport that both ends have. To subscriptions that listen at one multicast group it sends one
datagram to the group; to one that listens there alone, the same one datagram by unicast: both count
as multicast.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import msgspec

from lifecycle.manifest.model import EndpointKind, UniqueHow
from lifecycle.network.connection_url import ConnectionUrlError, parse
from lifecycle.network.medium import Medium
from lifecycle.network.nfe import (
    InternetProtocol,
    LocatedNfe,
    NetworkFlowEndpoint,
    TransportProtocol,
    canonical,
    dissimilar,
    is_ip,
    is_multicast,
    is_wildcard,
    located,
)
from lifecycle.verify.observation import EndpointReport, Identity, NodeConfiguration

if TYPE_CHECKING:
    from lifecycle.verify.view import Actual, FlowView

_Bucket = tuple[EndpointKind, InternetProtocol, TransportProtocol, int]


class _Entry(msgspec.Struct, frozen=True, kw_only=True):
    """One endpoint.

    Attributes:
        nfes: all that it reports; None if they are not known.
        judged: those of them that count.
    """

    kind: EndpointKind
    process: tuple[str, int]
    nfes: tuple[LocatedNfe, ...] | None
    judged: tuple[LocatedNfe, ...] | None


def _entry(configuration: NodeConfiguration, report: EndpointReport, address: str) -> _Entry:
    identity = configuration.identity
    nfes = located(
        report.nfes,
        identity.machine_id,
        dscp=report.dscp if report.kind is EndpointKind.PUBLISHER else None,
    )
    return _Entry(
        kind=report.kind,
        process=(identity.machine_id, identity.process_id),
        nfes=nfes,
        judged=None if nfes is None else _that_count(nfes, address),
    )


_Place = tuple[str, EndpointKind, str, str, str]


def _place(node: str, report: EndpointReport) -> _Place:
    return node, report.kind, report.name, report.resolved, report.gid


class Uniqueness:
    """Answers for every reported endpoint whether it is unique.

    Args:
        configurations: of every node.
        addresses: declared address of each node's machine, by full node name.
    """

    def __init__(
        self,
        configurations: Iterable[NodeConfiguration],
        addresses: Mapping[str, str],
    ) -> None:
        self._entries: dict[_Place, _Entry] = {}
        # NFEs with another port or protocol are dissimilar whatever else they hold, so only those
        # of one bucket are ever compared: judging grows with the endpoints, not with their square.
        # Endpoints of one participant have the same NFEs, so each is kept once, with how many.
        self._buckets: dict[_Bucket, Counter[LocatedNfe]] = {}
        self._unknown: set[tuple[EndpointKind, tuple[str, int]]] = set()
        for configuration in configurations:
            address = addresses.get(configuration.name, "")
            for report in configuration.endpoints:
                if report.kind.is_topic and not report.error:
                    entry = _entry(configuration, report, address)
                    # Of several reports of one name the first counts.
                    self._entries.setdefault(_place(configuration.name, report), entry)
                    if entry.judged is None:
                        self._unknown.add((entry.kind, entry.process))
                    for each in {*(entry.judged or ())}:
                        self._buckets.setdefault(_bucket(entry.kind, each), Counter())[each] += 1
        self._answers = {each: self._judge(entry) for each, entry in self._entries.items()}

    def nfes(self, end: Actual | None) -> tuple[NetworkFlowEndpoint, ...]:
        """Return the NFEs of an endpoint, each once, with the DSCP that was read back."""
        if end is None or end.report is None:
            return ()
        entry = self._entries.get(_place(end.node, end.report))
        return tuple(dict.fromkeys(each.nfe for each in (entry.nfes if entry else None) or ()))

    def is_unique(self, end: Actual | None) -> bool | None:
        """Return whether an endpoint is unique; None when its NFEs are not known."""
        if end is None or end.report is None:
            return None
        return self._answers.get(_place(end.node, end.report))

    def _judge(self, entry: _Entry) -> bool | None:
        if entry.judged is None:
            return None
        own = [each for each in entry.judged if is_ip(each.nfe)]
        for each in own:
            seen = self._buckets[_bucket(entry.kind, each)]
            if seen[each] > 1 or not all(one in own or dissimilar(each, one) for one in seen):
                return False
        if not own:
            return False  # the network sees nothing of it
        return None if (entry.kind, entry.process) in self._unknown else True


def meets(demanded: UniqueHow, *, publisher: bool | None, subscription: bool | None) -> bool | None:
    """Return whether a flow is at least as unique as demanded; None when that is unknown.

    One end that is unique is enough for WEAKLY, whatever is not known of the other; one that is
    not is enough to fail STRONGLY.
    """
    ends = (publisher, subscription)
    if demanded is UniqueHow.NOT:
        return True
    decisive = demanded is UniqueHow.WEAKLY
    if decisive in ends:
        return decisive
    return None if None in ends else not decisive


def _that_count(nfes: tuple[LocatedNfe, ...], address: str) -> tuple[LocatedNfe, ...]:
    """Return the NFEs on the address that the machine is declared to have; all if none is.

    A host has addresses that lead nowhere outside, and many hosts have the same: each container
    bridge is 172.17.0.1. Two endpoints on two of them do not share a flow. Wildcards and groups
    count as the declared address too.
    """
    wanted = canonical(address)
    found = tuple(
        each
        for each in nfes
        if is_wildcard(each.nfe.internet_address)
        or is_multicast(each.nfe.internet_address)
        or canonical(each.nfe.internet_address) == wanted
    )
    unicast = any(not is_multicast(each.nfe.internet_address) for each in found)
    return found if address and unicast else nfes


def _bucket(kind: EndpointKind, located_nfe: LocatedNfe) -> _Bucket:
    nfe = located_nfe.nfe
    return (kind, nfe.internet_protocol, nfe.transport_protocol, nfe.transport_port)


NONE = "none"
UNKNOWN = "unknown"

_ANY_PORT = 0
"""Of the NFE made from a URL: no port distinguishes one transport from another."""


def effective_transport(flow: FlowView) -> str:
    """Return what carries a planned flow, as `carrier` says."""
    source, destination = (each.configuration for each in flow.nodes)
    return carrier(
        _ways(source, flow.writer),
        _ways(destination, flow.reader),
        None if source is None else source.identity,
        None if destination is None else destination.identity,
    )


def _ways(
    configuration: NodeConfiguration | None, end: Actual | None
) -> tuple[NetworkFlowEndpoint, ...]:
    """Return the NFEs of one side, and what it was connected to where they do not show it.

    rmw_fastrtps lists no NFE of a TCP transport at a publisher.
    """
    report = None if end is None else end.report
    if configuration is None or report is None or report.nfes is None:
        return ()
    listed = {each.transport_protocol for each in report.nfes}
    connected = (
        _as_nfe(url)
        for each in configuration.connections
        if report.mapped and each.name == report.connection
        for url in each.urls
    )
    tcp = TransportProtocol.TCP
    return (
        *report.nfes,
        *(
            each
            for each in connected
            if each is not None
            and (not listed or (each.transport_protocol is tcp and tcp not in listed))
        ),
    )


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
