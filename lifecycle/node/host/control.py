"""The control channel between a supervisor and the processes that host our nodes.

Owns: the messages, one JSON object per line over an inherited AF_UNIX stream socket. It carries
what the lifecycle services and `~/get_configuration` carry, without waiting for discovery; both
ways drive the same state machine. End of file from the supervisor makes a host shut down. Pure.
"""

from __future__ import annotations

import dataclasses
import enum

from lifecycle.manifest.model import DiscoveryRange
from lifecycle.plan.model import ParticipantConnections, PlannedNode
from lifecycle.verify.observation import NodeConfiguration

SIGN_DESCRIPTORS = 2
"""Beside the first byte of the HostSpec come the two descriptors of the busy sign, by which the
host's executor is watched (SCM_RIGHTS, unix(7)); a host that gets none is not watched."""


class Operation(enum.Enum):
    """What a supervisor may ask of one node; each is answered by exactly one Reply."""

    CONFIGURE = "configure"
    CONNECT = "connect"
    ACTIVATE = "activate"
    DEACTIVATE = "deactivate"
    DISCONNECT = "disconnect"
    CLEANUP = "cleanup"
    SHUTDOWN = "shutdown"
    GET_CONFIGURATION = "get_configuration"
    # The node interface (*Topological Discovery and Communication Negotiation*).
    CONNECT_TO = "connect_to"  # connection, urls
    MAP_TO = "map_to"  # endpoint, connection
    DISCONNECT_FROM = "disconnect_from"  # connection
    # Of the whole process: a link is down, and send again soon what nobody acknowledged; and tell
    # the graph anew which nodes are here.
    SEND_AGAIN_SOON = "send_again_soon"
    TELL_NAMES = "tell_names"


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class HostSpec:
    """First line from the supervisor: what this process hosts."""

    system: str
    process: str
    domain_id: int
    discovery_range: DiscoveryRange
    nodes: tuple[PlannedNode, ...]


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Supervisor → host.

    Attributes:
        node: fully qualified name.
        connection: name of a connection, for CONNECT_TO, MAP_TO and DISCONNECT_FROM.
        connections: what to connect to, for CONNECT_TO.
        endpoint: `publishers/video`, kind and declared name, for MAP_TO.
    """

    id: int
    node: str
    operation: Operation
    connection: str = ""
    connections: ParticipantConnections = ParticipantConnections()
    endpoint: str = ""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Event:
    """Host → supervisor; exactly one of the groups below is set.

    Attributes:
        kind: "ready" (all nodes constructed, executor spinning), "failed" (construction failed;
            `error` says why, the process exits), "state" (a node's state changed), "reply",
            "beat" (the executor has come back from a callback that took too long),
            "configuration" (it changed: endpoints, connections, mappings or matches).
        id: the Command's id, for "reply".
        ok: the operation succeeded, for "reply".
        state: lifecycle_msgs/State label after it.
        connected: the data layer is made.
        error: the reason, with the exception's last line; the traceback is in the log.
        configuration: for "configuration", and replies that carry it (all but ACTIVATE,
            DEACTIVATE, CLEANUP and SHUTDOWN).
    """

    kind: str
    node: str = ""
    id: int = 0
    ok: bool = True
    state: str = ""
    connected: bool = False
    error: str = ""
    configuration: NodeConfiguration | None = None
