"""Network flows as tuples: what a source and a destination NFE make together.

Owns: which NFEs of a publisher and a subscription form a flow, as *Unique Network Flows* describes
it: a 5-tuple, on IPv6 a flow label beside it, and the DSCP. Pure.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence

from lifecycle.network.address import canonical, is_loopback, is_multicast, is_wildcard, socket_text
from lifecycle.network.nfe import (
    InternetProtocol,
    NetworkFlowEndpoint,
    TransportProtocol,
    is_ip,
)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class FlowTuple:
    """One network flow.

    Attributes:
        source_address: `0.0.0.0` or `::` where the sender's routing decides per packet.
        source_port: 0–65535.
        destination_address: unicast, or a group.
        destination_port: 0–65535.
        flow_label: IPv6 flow label, 0–0xFFFFF; 0 if the sender sets none (RFC 6437 §2), which
            leaves it to the kernel and to rules on the way.
        dscp: 0–63.
    """

    transport_protocol: TransportProtocol
    internet_protocol: InternetProtocol
    source_address: str
    source_port: int
    destination_address: str
    destination_port: int
    flow_label: int = 0
    dscp: int = 0

    @property
    def source_is_known(self) -> bool:
        """Whether the source address is one address, so that the whole 5-tuple is known."""
        return not is_wildcard(self.source_address)

    @property
    def source(self) -> str:
        """`10.0.0.1:7411`, `[fd00::1]:7411`."""
        return socket_text(self.source_address, self.source_port)

    @property
    def destination(self) -> str:
        """As `source`."""
        return socket_text(self.destination_address, self.destination_port)

    @property
    def label(self) -> str:
        """The flow label in five hex digits, `unset`, or empty on IPv4, which has none."""
        if self.internet_protocol is not InternetProtocol.IPV6:
            return ""
        return f"{self.flow_label:#07x}" if self.flow_label else "unset"

    def describe(self) -> str:
        """Return the 5-tuple, on IPv6 with the label that makes a 3-tuple of its addresses.

        `udp 10.0.0.1:7411 → 10.0.0.2:7000`, `udp [fd00::1]:7411 → [fd00::2]:7000 flow_label unset`.
        """
        label = f" flow_label {self.label}" if self.label else ""
        return f"{self.transport_protocol.value} {self.source} → {self.destination}{label}"


def flow_tuples(
    source: Iterable[NetworkFlowEndpoint], destination: Iterable[NetworkFlowEndpoint]
) -> tuple[FlowTuple, ...]:
    """Return the IP flows that a publisher's and a subscription's NFEs can form, each once.

    Fast DDS sends unicast from its `0.0.0.0` sockets and multicast from those of one interface
    each, so where a sender has both kinds, each destination gets its own kind. A loopback address
    only ever talks to a loopback address. Shared memory forms no flow.
    """
    senders = [each for each in source if is_ip(each)]
    found: dict[FlowTuple, None] = {}
    for end in destination:
        for sender in _senders_to(end, senders) if is_ip(end) else ():
            flow = FlowTuple(
                transport_protocol=end.transport_protocol,
                internet_protocol=end.internet_protocol,
                source_address=canonical(sender.internet_address),
                source_port=sender.transport_port,
                destination_address=canonical(end.internet_address),
                destination_port=end.transport_port,
                flow_label=sender.flow_label,
                dscp=sender.dscp,
            )
            found[flow] = None
    return tuple(found)


def _senders_to(
    end: NetworkFlowEndpoint, senders: Sequence[NetworkFlowEndpoint]
) -> Sequence[NetworkFlowEndpoint]:
    fitting = [
        each
        for each in senders
        if each.transport_protocol is end.transport_protocol
        and each.internet_protocol is end.internet_protocol
        and _may_reach(each.internet_address, end.internet_address)
    ]
    multicast = is_multicast(end.internet_address)
    own_kind = [each for each in fitting if is_wildcard(each.internet_address) is not multicast]
    return own_kind or fitting


def _may_reach(source: str, destination: str) -> bool:
    if is_wildcard(source) or is_multicast(destination):
        return True
    return is_loopback(source) == is_loopback(destination)
