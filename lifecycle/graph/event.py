"""What subscribers of the graph are told.

Owns: the event type, its kinds, and what is known of a member of the graph. Pure.
"""

from __future__ import annotations

import dataclasses
import enum

from lifecycle.graph.messages import GraphMessage
from lifecycle.verify.observation import EndpointReport


class EventKind(enum.Enum):
    """What happened; the first nine follow from the message of the same name."""

    JOINED = "joined"
    LEFT = "left"
    STATE_CHANGED = "state_changed"
    HEARTBEAT = "heartbeat"
    CONFIGURATION_CHANGED = "configuration_changed"
    CONNECTION_ESTABLISHED = "connection_established"
    CONNECTION_LOST = "connection_lost"
    MAPPING_ESTABLISHED = "mapping_established"
    MAPPING_LOST = "mapping_lost"
    SILENT = "silent"  # nothing is heard of the node
    STUCK = "stuck"  # the node is there and does not do its work
    ALIVE = "alive"  # neither of the two any more
    GAP = "gap"  # messages of the node were lost: read its configuration again
    ENDPOINT_ADDED = "endpoint_added"
    ENDPOINT_REMOVED = "endpoint_removed"
    ENDPOINT_CHANGED = "endpoint_changed"


class NodeLiveliness(enum.Enum):
    """Whether a member of the graph is there and does its work."""

    ALIVE = "alive"
    STUCK = "stuck"
    SILENT = "silent"


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class GraphEvent:
    """One thing that happened.

    Attributes:
        node: fully qualified name of the node that it happened to.
        incarnation: of that node; empty if it sends no graph messages.
        message: what told it; None if discovery, silence or a configuration did.
        reason: for people; empty if there is none.
        endpoint: for the three ENDPOINT kinds; as it is now, or was.
    """

    kind: EventKind
    node: str
    incarnation: str = ""
    message: GraphMessage | None = None
    reason: str = ""
    endpoint: EndpointReport | None = None


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Member:
    """A node that is part of the graph, as far as its messages tell.

    Attributes:
        incarnation: empty if it sends no graph messages: then discovery has shown it.
        state: lifecycle_msgs/State label; None while unknown.
        connected: its data layer is made; None while unknown.
        checksum: of its node configuration; None while unknown, empty if it serves none.
        reason: why it is silent or stuck; empty if it is alive.
    """

    node: str
    incarnation: str = ""
    state: str | None = None
    connected: bool | None = None
    checksum: str | None = None
    liveliness: NodeLiveliness = NodeLiveliness.ALIVE
    reason: str = ""
