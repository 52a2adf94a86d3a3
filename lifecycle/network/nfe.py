"""Network flow endpoints (NFEs), flow tuples, uniqueness, as *Unique Network Flows* defines them.

Owns: the NFE tuple, the requirement enum, when two NFEs are dissimilar; which NFEs of a publisher
(source) and a subscription (destination) form a flow: a 5-tuple, on IPv6 a flow label beside it,
and the DSCP; addresses as text: one spelling each, by the scope rules of RFC 4007 and RFC 6890.

The article defines uniqueness for one NFE. An endpoint usually has several, and the middleware
chooses per packet. Here an endpoint is unique when *every* IP NFE of it is dissimilar to every NFE
of every other endpoint: one shared NFE (a multicast group, say) is a path on which the network
cannot distinguish the endpoints. Publishers are compared with publishers, subscriptions with
subscriptions. Pure.
"""

from __future__ import annotations

import enum
import functools
import ipaddress
from collections.abc import Iterable, Sequence

import msgspec
from msgspec.structs import replace

from lifecycle.codec import DscpValue, FlowLabel, PortOrNone
from lifecycle.network.medium import Medium

IpAddress = ipaddress.IPv4Address | ipaddress.IPv6Address


@functools.lru_cache(maxsize=4096)
def parse_address(text: str) -> IpAddress | None:
    """Return the address that `text` spells, else None (empty, a host name, …)."""
    try:
        return ipaddress.ip_address(text)
    except ValueError:
        return None


@functools.lru_cache(maxsize=4096)
def canonical(text: str) -> str:
    """Return the one spelling of an address (RFC 5952); text that is none is returned unchanged."""
    address = parse_address(text)
    return text if address is None else str(address)


def socket_text(address: str, port: int) -> str:
    """Return address and port as URLs write them: `10.0.0.1:7411`, `[fd00::1]:7411`."""
    return f"[{address}]:{port}" if ":" in address else f"{address}:{port}"


@functools.lru_cache(maxsize=4096)
def is_wildcard(text: str) -> bool:
    """Whether this is `0.0.0.0` or `::`, which means every unicast address of its host."""
    address = parse_address(text)
    return address is not None and address.is_unspecified


@functools.lru_cache(maxsize=4096)
def is_multicast(text: str) -> bool:
    """Whether this is a group, which is the same destination from wherever it is named."""
    address = parse_address(text)
    return address is not None and address.is_multicast


def is_loopback(text: str) -> bool:
    """Whether this address never leaves its host."""
    address = parse_address(text)
    return address is not None and address.is_loopback


def may_be_same(a: str, b: str, *, same_machine: bool | None) -> bool:
    """Return whether packets of two sockets with these local addresses can carry one address.

    - Groups and global addresses are the same where their spelling is: the network cannot
      distinguish two machines that claim one address.
    - `0.0.0.0` and `::` mean every unicast address of their machine.
    - Loopback and link-local addresses mean something on their own machine and link only
      (RFC 6890, RFC 4007).

    Where it is not known whether both are on one machine (None), they may be the same.
    """
    one, other = parse_address(a), parse_address(b)
    if one is None or other is None:
        return a == b
    if one.is_multicast or other.is_multicast:
        return one == other
    apart = same_machine is False
    if one.is_unspecified or other.is_unspecified:
        return not apart
    if apart and (one.is_loopback or one.is_link_local):
        return False
    if isinstance(one, ipaddress.IPv6Address) and isinstance(other, ipaddress.IPv6Address):
        # A zone counts only where both name one.
        zones_differ = one.scope_id and other.scope_id and one.scope_id != other.scope_id
        return one.packed == other.packed and not zones_differ
    return one == other


class TransportProtocol(enum.Enum):
    """Transport protocol of an NFE (rmw_transport_protocol_t); UNKNOWN covers shared memory."""

    UNKNOWN = "unknown"
    UDP = "udp"
    TCP = "tcp"


class InternetProtocol(enum.Enum):
    """Internet protocol of an NFE (rmw_internet_protocol_t); UNKNOWN covers shared memory."""

    UNKNOWN = "unknown"
    IPV4 = "ipv4"
    IPV6 = "ipv6"


_VERSIONS = {InternetProtocol.IPV4: "v4", InternetProtocol.IPV6: "v6"}


class UniqueRequirement(enum.Enum):
    """`require_unique_network_flow_endpoints`: a creation-time option of every endpoint."""

    NOT_REQUIRED = "not_required"
    STRICTLY_REQUIRED = "strictly_required"
    OPTIONALLY_REQUIRED = "optionally_required"
    SYSTEM_DEFAULT = "system_default"

    @property
    def asks(self) -> bool:
        """Whether we give an endpoint with it an NFE of its own."""
        return self in (UniqueRequirement.STRICTLY_REQUIRED, UniqueRequirement.OPTIONALLY_REQUIRED)

    @property
    def rmw_value(self) -> int:
        """The number in rmw_unique_network_flow_endpoints_requirement_t."""
        return list(UniqueRequirement).index(self)


class NetworkFlowEndpoint(msgspec.Struct, frozen=True, kw_only=True):
    """The part of a network flow that belongs to one publisher or subscription.

    Field names are those of rmw_network_flow_endpoint_t. Equality is the article's "not
    dissimilar"; `dissimilar` adds what textual equality cannot know: wildcards and other spellings.

    Attributes:
        transport_port: 0 where the transport has none.
        flow_label: IPv6 flow label, publishers only.
        dscp: publishers only.
        internet_address: textual address, empty for shared memory.
    """

    transport_protocol: TransportProtocol
    internet_protocol: InternetProtocol
    transport_port: PortOrNone
    flow_label: FlowLabel = 0
    dscp: DscpValue = 0
    internet_address: str = ""

    def describe(self) -> str:
        """Return it for people: `10.0.0.1:7411`, `[fd00::1]:7411`, or `shm`."""
        if self.transport_protocol is TransportProtocol.UNKNOWN:
            return self.medium
        return socket_text(self.internet_address, self.transport_port)

    @property
    def medium(self) -> str:
        """What it is of, as `Medium` spells it; `shm` where there is no protocol (rmw_fastrtps)."""
        if self.transport_protocol is TransportProtocol.UNKNOWN:
            return Medium.SHM
        return f"{self.transport_protocol.value}{_VERSIONS.get(self.internet_protocol, '')}"


class LocatedNfe(msgspec.Struct, frozen=True, kw_only=True):
    """An NFE and the machine it is on, which defines what `0.0.0.0` and `127.0.0.1` mean.

    Attributes:
        machine_id: any text that is equal on one machine only; empty when not known: then it may be
            on any, and comparisons lean to "not dissimilar".
    """

    machine_id: str
    nfe: NetworkFlowEndpoint


def located(
    nfes: Iterable[NetworkFlowEndpoint] | None, machine_id: str, *, dscp: int | None = None
) -> tuple[LocatedNfe, ...] | None:
    """Return an endpoint's NFEs with their machine; None (not known) stays None.

    `dscp` is read back from the sender sockets: Fast DDS always reports 0, whatever is marked.
    """
    if nfes is None:
        return None
    marked = nfes if dscp is None else (replace(each, dscp=dscp) for each in nfes)
    return tuple(LocatedNfe(machine_id=machine_id, nfe=each) for each in marked)


def is_ip(nfe: NetworkFlowEndpoint) -> bool:
    """Whether this is an end of an IP flow; shared memory has neither protocol nor address."""
    return (
        nfe.transport_protocol is not TransportProtocol.UNKNOWN
        and nfe.internet_protocol is not InternetProtocol.UNKNOWN
        and bool(nfe.internet_address)
    )


def dissimilar(a: LocatedNfe, b: LocatedNfe) -> bool:
    """Return whether one or more networking resources of two NFEs differ.

    Addresses differ unless packets of both can carry the same one: a publisher that sends from
    `0.0.0.0:p` sends from every address of its machine, and two machines' `0.0.0.0` differ. Both
    are of publishers or both of subscriptions.
    """
    one, other = a.nfe, b.nfe
    if replace(one, internet_address="") != replace(other, internet_address=""):
        return True
    machines = a.machine_id, b.machine_id
    return not may_be_same(
        one.internet_address,
        other.internet_address,
        same_machine=machines[0] == machines[1] if all(machines) else None,
    )


class FlowTuple(msgspec.Struct, frozen=True, kw_only=True):
    """One network flow.

    Attributes:
        source_address: `0.0.0.0` or `::` where the sender's routing decides per packet.
        destination_address: unicast, or a group.
        flow_label: IPv6 flow label; 0 if the sender sets none (RFC 6437 §2), which leaves it to the
            kernel and to rules on the way.
    """

    transport_protocol: TransportProtocol
    internet_protocol: InternetProtocol
    source_address: str
    source_port: PortOrNone
    destination_address: str
    destination_port: PortOrNone
    flow_label: FlowLabel = 0
    dscp: DscpValue = 0

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
    only ever sends to a loopback address. Shared memory forms no flow.
    """
    senders = [each for each in source if is_ip(each)]
    return tuple(
        dict.fromkeys(
            FlowTuple(
                transport_protocol=end.transport_protocol,
                internet_protocol=end.internet_protocol,
                source_address=canonical(sender.internet_address),
                source_port=sender.transport_port,
                destination_address=canonical(end.internet_address),
                destination_port=end.transport_port,
                flow_label=sender.flow_label,
                dscp=sender.dscp,
            )
            for end in destination
            if is_ip(end)
            for sender in _senders_to(end, senders)
        )
    )


def _senders_to(
    end: NetworkFlowEndpoint, senders: Sequence[NetworkFlowEndpoint]
) -> Sequence[NetworkFlowEndpoint]:
    multicast = is_multicast(end.internet_address)
    fitting = [
        each
        for each in senders
        if each.transport_protocol is end.transport_protocol
        and each.internet_protocol is end.internet_protocol
        and (
            multicast
            or is_wildcard(each.internet_address)
            or is_loopback(each.internet_address) == is_loopback(end.internet_address)
        )
    ]
    own_kind = [each for each in fitting if is_wildcard(each.internet_address) is not multicast]
    return own_kind or fitting
