"""The frozen manifest: what a document says once it is valid, arguments and includes resolved.

Owns: the types that cross from this room into plan/, all of which can be had from here: the words
are in choices.py, what is said of one node in node_model.py. Nothing here knows YAML. Pure.
"""

from __future__ import annotations

import dataclasses

from lifecycle.manifest.choices import (
    Authority,
    Condition,
    DataLayerSource,
    DiscoveryMode,
    DiscoveryRange,
    EndpointKind,
    EndpointPolicy,
    FlowIdentification,
    FlowTransport,
    RunKind,
    UniqueHow,
)
from lifecycle.manifest.diagnostics import Position, Severity
from lifecycle.manifest.node_model import (
    After,
    ConnectionDeclaration,
    Endpoint,
    FlowNeed,
    Interface,
    Node,
    ParameterDeclaration,
    ParameterValue,
    Quantity,
    Run,
    Timeouts,
)
from lifecycle.network.five_qi_dscp import DscpMapping
from lifecycle.network.transport_priority import TransportPriorityMapping

__all__ = [
    "TOLERATED_NODES",
    "After",
    "Authority",
    "Condition",
    "ConnectionDeclaration",
    "DataLayer",
    "DataLayerSource",
    "Discovery",
    "DiscoveryMode",
    "DiscoveryRange",
    "Endpoint",
    "EndpointKind",
    "EndpointPolicy",
    "FlowIdentification",
    "FlowNeed",
    "FlowTransport",
    "Interface",
    "Link",
    "Machine",
    "Manifest",
    "Network",
    "Node",
    "ParameterDeclaration",
    "ParameterValue",
    "Policy",
    "Quantity",
    "Run",
    "RunKind",
    "Timeouts",
    "UniqueHow",
]


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Machine:
    """A host. `address` is an IPv4 or IPv6 address, or empty for this host."""

    name: str
    address: str = ""
    at: Position


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Discovery:
    """How participants find each other.

    Attributes:
        domain_id: 0–232; None takes ROS_DOMAIN_ID, else 0.
        transport: what the nodes' own participants use, UDPV4, UDPV6, TCPV4 or SHM; ANY leaves it
            to the middleware, or takes what the mode needs: UDPV4 for STATIC and STATIC_ENDPOINTS,
            TCPV4 for SERVER.
        first_port: first of the ports given out where the mode fixes them, per machine, 1024–65535.
        server_machine: runs the discovery server; empty for the first machine.
    """

    domain_id: int | None = None
    mode: DiscoveryMode = DiscoveryMode.DYNAMIC
    range: DiscoveryRange = DiscoveryRange.SYSTEM_DEFAULT
    transport: FlowTransport = FlowTransport.ANY
    first_port: int = 7910
    server_machine: str = ""
    at: Position | None = None


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class DataLayer:
    """How endpoints come onto connections; for the whole system.

    Attributes:
        authority: who calls connect_to and map_to.
        source: what the data layer graph is made from.
        events: connections and mappings are followed by graph events, and made again when lost.
        multicast_group: where groups are given out from, one per topic that goes by multicast.
    """

    authority: Authority = Authority.NODES
    source: DataLayerSource = DataLayerSource.STATIC
    events: bool = False
    multicast_group: str = "239.255.1.1"
    at: Position | None = None


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Network:
    """How flow needs become network resources; for the whole system.

    Attributes:
        flow_identification: how publishers that need a unique flow get one.
        transport_priority_mapping: what `transport_priority` goes through, as Connext Micro
            computes it; None takes the value as the TOS byte itself (mask 0xff).
        five_qi_dscp: marks publishers that ask for a 5QI and no DSCP; None marks none.
        max_datagram_bytes: UDP payload that the path carries unfragmented; None assumes Ethernet.
    """

    flow_identification: FlowIdentification = FlowIdentification.PARTICIPANT
    transport_priority_mapping: TransportPriorityMapping | None = None
    five_qi_dscp: DscpMapping | None = None
    max_datagram_bytes: int | None = None
    at: Position | None = None


TOLERATED_NODES = (
    "_ros2cli_*",
    "launch_ros_*",
    "rqt_*",
    "rviz",
    "rviz2",
    "rviz_*",
    "rosbag2_recorder",
    "rosbag2_player",
    "transform_listener_impl_*",
)
"""Names of nodes that tools make, as the tools choose them: the default of `tolerated_nodes`."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Policy:
    """How strict checks and verification are.

    Attributes:
        undeclared_nodes: OPEN tolerates nodes of other systems in the graph.
        tolerated_nodes: patterns of names of nodes that may be there although nobody declared them,
            as long as they only listen: `*` stands for any characters, `?` for one; a pattern with
            a slash is compared with the full name, any other with the base name.
        unverifiable_blocks: an unverifiable finding closes the gate.
        unpublished: severity of a subscription that nobody publishes; None ignores it.
        unheard: severity of a publisher that nobody hears; None ignores it.
    """

    undeclared_nodes: EndpointPolicy = EndpointPolicy.DECLARED
    tolerated_nodes: tuple[str, ...] = TOLERATED_NODES
    unverifiable_blocks: bool = False
    unpublished: Severity | None = Severity.ERROR
    unheard: Severity | None = Severity.WARNING


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Link:
    """What must hold between one publisher's and one subscription's node.

    Attributes:
        topic: fully qualified name.
        from_node: manifest key of the publishing node.
        to_node: manifest key of the subscribing node.
        max_delay_ms: > 0; None if not asked for.
        transport: overrides what would be negotiated for this pair.
        quantities: each of its numbers that only a measurement could prove, as it is written.
    """

    topic: str
    from_node: str
    to_node: str
    unique: UniqueHow = UniqueHow.NOT
    max_delay_ms: float | None = None
    transport: FlowTransport = FlowTransport.ANY
    quantities: tuple[Quantity, ...] = ()
    at: Position


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Manifest:
    """One system, valid on its own; the input of `lifecycle.plan`.

    Attributes:
        path: the file it was read from, as the user wrote it.
        arguments: resolved values by name.
        positions: where values of `discovery:` and `data_layer:` stand, by path, `discovery.mode`.
    """

    path: str
    system: str
    description: str = ""
    arguments: tuple[tuple[str, str], ...] = ()
    machines: tuple[Machine, ...] = ()
    discovery: Discovery = Discovery()
    network: Network = Network()
    data_layer: DataLayer = DataLayer()
    policy: Policy = Policy()
    nodes: tuple[Node, ...] = ()
    links: tuple[Link, ...] = ()
    positions: tuple[tuple[str, Position], ...] = ()

    def where(self, path: str, section: Position) -> Position:
        """Return where a value stands; the position of its section where it is not written."""
        return dict(self.positions).get(path, section)
