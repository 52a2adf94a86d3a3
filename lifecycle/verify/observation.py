"""What was seen of a running system: the input of `verify` beside the plan.

Owns: the observation types and the node configuration (schema: schemas/node_configuration.v1
.schema.json), which nodes report and observers collect. Pure.
"""

from __future__ import annotations

import dataclasses

from lifecycle.manifest.model import EndpointKind
from lifecycle.manifest.qos import QosProfile
from lifecycle.network.nfe import NetworkFlowEndpoint, UniqueRequirement


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Identity:
    """What tells one node instance from every other.

    Attributes:
        machine_id: /etc/machine-id, or the boot id where there is none.
        process_id: pid in the node's own pid namespace.
        node_id: fully qualified name and the participant's GID prefix, `/robot/camera@0103…`.
    """

    machine_id: str
    process_id: int
    node_id: str


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ConnectionReport:
    """What a node says of one of its connections.

    Attributes:
        name: as `connect_to` named it; empty for the node's own participant.
        urls: what it was told, as text; empty if the RMW chose.
        node_name: base name of the hidden node that carries it; empty for the node's own.
        established: it exists and, where it has mappings, all of them have a matched peer.
        mappings: declared names of what is mapped onto it, `publishers/video`.
        error: why it could not be made; empty if it was.
    """

    name: str
    urls: tuple[str, ...] = ()
    node_name: str = ""
    established: bool = False
    mappings: tuple[str, ...] = ()
    error: str = ""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class EndpointReport:
    """What a node says of one of its endpoints.

    Attributes:
        name: declared name; empty for one that no interface declares.
        resolved: fully qualified.
        gid: hex, empty if not yet created or not known.
        nfes: this endpoint's own network flow endpoints; None where the RMW cannot tell.
        participant: base name of the hidden node that carries it; empty for the node's own.
        matched: number of matched remote endpoints; None where unknown.
        server_matched: of a service or action client that exists: a server of its name is matched
            with it both ways; None for everything else and where the RMW cannot tell.
        dscp: DSCP read back from the sender sockets with getsockopt, 0–63; None if not read.
        error: why the endpoint could not be made as asked; empty if it was.
        connection: name of the connection it is mapped onto; empty for the node's own participant,
            or while it is mapped nowhere.
        mapped: it exists on a connection.
        aliases: fully qualified further names that it was given while running.
        lossy: the node's hint: its data bear an unreliable transport; None without one.
        size_bytes: the node's hint: its largest serialized message; None without one.
    """

    kind: EndpointKind
    name: str
    resolved: str
    type: str
    qos: QosProfile | None = None
    gid: str = ""
    unique: UniqueRequirement = UniqueRequirement.NOT_REQUIRED
    nfes: tuple[NetworkFlowEndpoint, ...] | None = None
    participant: str = ""
    matched: int | None = None
    server_matched: bool | None = None
    dscp: int | None = None
    error: str = ""
    connection: str = ""
    mapped: bool = False
    aliases: tuple[str, ...] = ()
    lossy: bool | None = None
    size_bytes: int | None = None


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class NodeConfiguration:
    """The node configuration interface's document.

    Attributes:
        name: fully qualified node name.
        state: lifecycle_msgs/State label.
        connected: the data layer is made (nested state of inactive; True while active).
        transports: what the node can be connected by, e.g. "udpv4", "shm".
        serializations: wire formats, "cdr".
        paradigms: "publish-subscribe", "request-response".
        connections: every connection that exists or was asked for.
        checksum: of everything but state, matches, whether connections are established, and itself;
            changes exactly when a reader must read again. Hex SHA-256, 16 digits.
    """

    identity: Identity
    name: str
    state: str
    connected: bool
    rmw: str
    transports: tuple[str, ...]
    serializations: tuple[str, ...]
    paradigms: tuple[str, ...]
    endpoints: tuple[EndpointReport, ...]
    checksum: str = ""
    connections: tuple[ConnectionReport, ...] = ()


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ObservedNode:
    """A node name in the graph.

    Attributes:
        count: how many nodes carry this name; more than one is a duplicate.
        state: lifecycle_msgs/State label; None if it could not be learnt.
        managed: it offers the lifecycle services; None if unknown.
    """

    full_name: str
    count: int = 1
    state: str | None = None
    managed: bool | None = None


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ObservedEndpoint:
    """An endpoint as discovery shows it.

    Attributes:
        node: fully qualified node name; empty while discovery does not know it.
        qos: history and depth are UNKNOWN/0 over Fast DDS; None for services and actions.
        gid: hex; empty for services and actions.
    """

    kind: EndpointKind
    node: str
    name: str
    type: str
    qos: QosProfile | None = None
    gid: str = ""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Observation:
    """Everything seen of a system at one moment, noise of tools already taken out."""

    nodes: tuple[ObservedNode, ...] = ()
    endpoints: tuple[ObservedEndpoint, ...] = ()
    configurations: tuple[NodeConfiguration, ...] = ()
