"""Node statuses: what each node of a graph says of itself to all others, and its JSON.

The message of the graph topic (schema: schemas/node_status.v1.schema.json) is all that its node has
to say: the last one holds, whatever was lost before it. Pure. See *Topological Discovery and
Communication Negotiation*, "Graph Interface".
"""

from __future__ import annotations

import secrets
import time
from typing import Literal

import msgspec

from lifecycle import codec
from lifecycle.errors import LifecycleError
from lifecycle.verify.observation import NodeConfiguration
from lifecycle.verify.outcome import ConnectionReport

LONGEST_STATUS_BYTES = 1 << 20

_RANDOM_BYTES = 4


class NodeStatusError(LifecycleError):
    """Bytes that are no node status of a version that we know."""


class MappingStatus(msgspec.Struct, frozen=True, kw_only=True):
    """An endpoint that exists on a connection.

    Attributes:
        endpoint: kind and declared name, `publishers/video`.
        connection: name of the connection; empty for the node's own participant.
        matched: number of matched remote endpoints; null where unknown.
    """

    endpoint: str
    connection: str = ""
    matched: codec.Count | None = None


def mappings_of(configuration: NodeConfiguration) -> tuple[MappingStatus, ...]:
    """Return what a configuration says of mappings."""
    return tuple(
        MappingStatus(
            endpoint=each.kind.spell(each.name or each.resolved),
            connection=each.connection,
            matched=each.matched,
        )
        for each in configuration.endpoints
        if each.mapped
    )


class NodeStatus(msgspec.Struct, frozen=True, kw_only=True):
    """What a node of the graph is now. Readers pass over fields that they do not know.

    Attributes:
        version: of this schema.
        node: fully qualified name of the sender.
        instance: of the node: text that compares greater for one that was started later.
        state: lifecycle_msgs/State label; empty for a node that is not managed.
        connected: its data layer is made.
        checksum: of its node configuration, which is to be read again when this changes; empty if
            the node serves none.
        connections: all that exist or were asked for.
        mappings: of all endpoints that exist.
        left: it is no longer part of the graph; this instance never comes back.
        reason: why it left, for people.
    """

    version: Literal[1] = 1
    node: str
    instance: str
    state: str = ""
    connected: bool = False
    checksum: str = ""
    connections: tuple[ConnectionReport, ...] = ()
    mappings: tuple[MappingStatus, ...] = ()
    left: bool = False
    reason: str = ""


def new_instance() -> str:
    """Return a text that no other node instance has, and that compares greater than earlier ones.

    It begins with the wall clock's time. Where that was set back between two starts of a node, the
    new instance compares as the earlier one; readers take it once the other has left or is silent.
    """
    return f"{time.time_ns():020d}-{secrets.token_hex(_RANDOM_BYTES)}"


def encode(status: NodeStatus) -> bytes:
    """Return a status as one JSON object in UTF-8."""
    return codec.to_json(status)


def decode(data: bytes | str) -> NodeStatus:
    """Return the status that `data` holds; fields that it has besides are passed over.

    Raises:
        NodeStatusError: it is none, or of another version.
    """
    try:
        status = codec.from_json(data, NodeStatus, longest=LONGEST_STATUS_BYTES)
    except ValueError as error:
        raise NodeStatusError(f"cannot read a node status: {error}") from error
    if not status.node.startswith("/") or not status.instance:
        raise NodeStatusError(
            f"cannot be the status of node {status.node!r}, instance {status.instance!r}"
        )
    return status
