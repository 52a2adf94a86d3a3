"""The data layer graph: parties, negotiated connections and mappings.

Owns: `Party`, `Terms` and `DataLayerGraph`. The rules are in `media`, and `negotiate` applies them.
Pure.
"""

from __future__ import annotations

import msgspec

from lifecycle.manifest.model import EndpointKind, FlowTransport
from lifecycle.manifest.qos import QosProfile
from lifecycle.network.connection_url import Peer
from lifecycle.network.medium import CONNECTABLE, DEFAULT_TCP, RMW_DEFAULT, Medium
from lifecycle.plan.connections.hosts import Contact

PARADIGMS = ("publish-subscribe", "request-response")
"""Topics; services, and actions, which consist of both."""

SERIALIZATIONS = ("cdr",)
"""OMG's Common Data Representation, the one wire format of ROS 2's DDS and zenoh RMWs."""


End = tuple[str, EndpointKind, str]
"""An endpoint that takes part: key of its party, kind, declared name."""


class PartyEndpoint(msgspec.Struct, frozen=True, kw_only=True):
    """One publisher or subscription that takes part.

    Attributes:
        kind: PUBLISHER or SUBSCRIPTION.
        name: as declared, or the resolved name of one that no interface declares.
        resolved: fully qualified topic.
        by: transports of the participant that carries it anyway; empty for the node's own. A group
            is spelled `udpm@239.255.1.9:7901`.
        fixed: it cannot be mapped elsewhere.
        alone: it shares its participant with no other.
        group: endpoints that may share a participant have the same.
        transport: what its node's manifest asks for.
        lossy: the data bear an unreliable transport; None if not declared.
        size_bytes: largest serialized message; None if not known.
    """

    kind: EndpointKind
    name: str
    resolved: str
    type: str
    qos: QosProfile | None = None
    by: tuple[str, ...] = ()
    fixed: bool = False
    alone: bool = False
    group: str = ""
    transport: FlowTransport = FlowTransport.ANY
    lossy: bool | None = None
    size_bytes: int | None = None

    @property
    def label(self) -> str:
        """How `map_to` knows it, `publishers/video`."""
        return f"{self.kind.value}/{self.name}"


class Party(msgspec.Struct, frozen=True, kw_only=True):
    """One node, as negotiation sees it.

    Attributes:
        key: manifest key; the full name of a node that no manifest declares.
        full_name: `/robot/camera`.
        host: its host, see `lifecycle.plan.connections.hosts`; parties of equal hosts share memory.
        process: unique on the host.
        transports: all that it can be connected by.
        own: transports of its own participant; empty if not known.
        connectable: `connect_to` is there to be called.
        connections: names that are taken.
        contacts: where its own participant is reached.
    """

    key: str
    full_name: str
    host: str
    process: str
    transports: tuple[str, ...] = CONNECTABLE
    own: tuple[str, ...] = RMW_DEFAULT
    connectable: bool = True
    serializations: tuple[str, ...] = SERIALIZATIONS
    paradigms: tuple[str, ...] = PARADIGMS
    endpoints: tuple[PartyEndpoint, ...] = ()
    connections: tuple[str, ...] = ()
    contacts: tuple[Contact, ...] = ()


class Terms(msgspec.Struct, frozen=True, kw_only=True):
    """What a system's data layer is made under.

    Attributes:
        fixed: every port is planned, and nothing is found by multicast.
        server: the discovery server that every connection must know; None without.
        server_medium: it listens on TCPV4 or UDPV4.
        first_port: first of the ports given out, per host.
        taken: by host, ports that are not given out.
        multicast_group: first of the groups given out.
        max_datagram_bytes: UDP payload that the path carries unfragmented; None assumes Ethernet.
        observers: where the supervisors' observers are reached: every connection looks for them.
    """

    fixed: bool = False
    server: Peer | None = None
    server_medium: Medium = DEFAULT_TCP
    first_port: int = 7910
    taken: tuple[tuple[str, tuple[int, ...]], ...] = ()
    multicast_group: str = "239.255.1.1"
    max_datagram_bytes: int | None = None
    observers: tuple[Contact, ...] = ()


class NegotiatedFlow(msgspec.Struct, frozen=True, kw_only=True, order=True):
    """What carries one topic from one node to another.

    Attributes:
        publisher: key of the publishing party.
        subscription: key of the subscribing party.
        medium: as `PlannedFlow.medium`; empty where the RMW decides and it is not known.
        reason: one phrase for people.
    """

    topic: str
    publisher: str
    subscription: str
    medium: str
    reason: str


class NegotiatedConnection(msgspec.Struct, frozen=True, kw_only=True):
    """One connection that a node must have because its own participant does not do it.

    Attributes:
        node: key of the party.
        name: unique in the node.
        urls: the arguments of `connect_to`.
        map: labels of the endpoints that it carries, `publishers/video`, sorted.
        reason: one phrase for people.
    """

    node: str
    name: str
    urls: tuple[str, ...]
    map: tuple[str, ...]
    reason: str


class NegotiationProblem(msgspec.Struct, frozen=True, kw_only=True, order=True):
    """A pair that cannot be connected.

    Attributes:
        message: starts with "cannot" and names what each end can.
    """

    topic: str
    publisher: str
    subscription: str
    message: str
    hint: str = ""


class DataLayerGraph(msgspec.Struct, frozen=True, kw_only=True):
    """Everything that was negotiated; sorted throughout."""

    flows: tuple[NegotiatedFlow, ...] = ()
    connections: tuple[NegotiatedConnection, ...] = ()
    problems: tuple[NegotiationProblem, ...] = ()
