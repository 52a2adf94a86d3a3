"""Graph messages: what participants of the graph send to all others, and their JSON.

Owns: the message types, their JSON (schema: schemas/graph_message.v1.schema.json) and which of two
incarnations is the later one. How messages travel is transport.py's. Pure.

The kinds are those of *Topological Discovery and Communication Negotiation* ("A Fork in the
Features", "Graph Interface"). Every message but a heartbeat takes the next sequence number of its
sender; a heartbeat repeats the last one. So a heartbeat that is lost leaves no gap, and one that
arrives shows whether something before it was lost.
"""

from __future__ import annotations

import enum
import secrets
import time
from typing import ClassVar

from lifecycle import codec, dataclasses
from lifecycle.errors import LifecycleError

VERSION = 1
LONGEST_MESSAGE_BYTES = 65536
"""A graph message is a line, never a document; what is longer was not made by us."""

_RANDOM_BYTES = 4


class GraphMessageError(LifecycleError):
    """Bytes that are no graph message of a version that we know."""


class GraphKind(enum.Enum):
    """What a message says."""

    JOINED = "joined"
    LEFT = "left"
    STATE_CHANGED = "state_changed"
    HEARTBEAT = "heartbeat"
    CONFIGURATION_CHANGED = "configuration_changed"
    CONNECTION_ESTABLISHED = "connection_established"
    CONNECTION_LOST = "connection_lost"
    MAPPING_ESTABLISHED = "mapping_established"
    MAPPING_LOST = "mapping_lost"


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class GraphMessage:
    """What every message carries; sent are only the kinds below.

    Attributes:
        node: fully qualified name of the sender. It does not come from discovery: after a long
            partition Fast DDS no longer knows it.
        incarnation: `new_incarnation` of the sender; text that compares greater for a later one.
        sequence: >= 0; 1 for the first message of an incarnation.
    """

    kind: ClassVar[GraphKind]

    node: str
    incarnation: str
    sequence: int

    def __post_init__(self) -> None:
        """Refuse what no sender can be."""
        if not self.node.startswith("/") or not self.incarnation or self.sequence < 0:
            raise ValueError(
                f"cannot be from node {self.node!r}, incarnation {self.incarnation!r},"
                f" sequence {self.sequence}"
            )


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Joined(GraphMessage):
    """The sender is part of the graph from now on.

    Attributes:
        state: lifecycle_msgs/State label; empty for a node that is not managed.
        connected: its data layer is made.
        checksum: of its node configuration; empty if it has none.
    """

    kind: ClassVar[GraphKind] = GraphKind.JOINED

    state: str = ""
    connected: bool = False
    checksum: str = ""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Left(GraphMessage):
    """The sender is no longer part of the graph; this incarnation never comes back."""

    kind: ClassVar[GraphKind] = GraphKind.LEFT

    reason: str = ""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class StateChanged(GraphMessage):
    """The sender is in another lifecycle state, or its data layer was made or unmade."""

    kind: ClassVar[GraphKind] = GraphKind.STATE_CHANGED

    state: str
    connected: bool = False


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Heartbeat(GraphMessage):
    """The sender is there; a reader compares what it holds with this.

    `sequence` is that of the sender's last other message. The rest is as in `Joined`, as it is
    after that message.
    """

    kind: ClassVar[GraphKind] = GraphKind.HEARTBEAT

    state: str = ""
    connected: bool = False
    checksum: str = ""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ConfigurationChanged(GraphMessage):
    """The sender's node configuration has another checksum: read it again."""

    kind: ClassVar[GraphKind] = GraphKind.CONFIGURATION_CHANGED

    checksum: str


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ConnectionEstablished(GraphMessage):
    """A connection of the sender works. `connection` is empty for the node's own participant."""

    kind: ClassVar[GraphKind] = GraphKind.CONNECTION_ESTABLISHED

    connection: str
    urls: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ConnectionLost(GraphMessage):
    """A connection of the sender was unmade or no longer works; `error` says why it does not."""

    kind: ClassVar[GraphKind] = GraphKind.CONNECTION_LOST

    connection: str
    urls: tuple[str, ...] = ()
    error: str = ""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class MappingEstablished(GraphMessage):
    """An endpoint of the sender exists on a connection, or another peer matched it.

    Attributes:
        endpoint: `publishers/video`.
        matched: number of matched remote endpoints now; None where unknown.
    """

    kind: ClassVar[GraphKind] = GraphKind.MAPPING_ESTABLISHED

    endpoint: str
    connection: str = ""
    matched: int | None = None


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class MappingLost(GraphMessage):
    """An endpoint of the sender was taken off a connection, or has lost a matched peer.

    `matched` None: it was taken off; a number: it is still there and has so many peers left.
    """

    kind: ClassVar[GraphKind] = GraphKind.MAPPING_LOST

    endpoint: str
    connection: str = ""
    matched: int | None = None
    error: str = ""


MESSAGES: tuple[type[GraphMessage], ...] = (
    Joined,
    Left,
    StateChanged,
    Heartbeat,
    ConfigurationChanged,
    ConnectionEstablished,
    ConnectionLost,
    MappingEstablished,
    MappingLost,
)
"""Every kind of message."""

_TYPES = {type_.kind.value: type_ for type_ in MESSAGES}


def new_incarnation() -> str:
    """Return a text that no other node instance has, and that compares greater than earlier ones.

    It begins with the wall clock's time. Where that was set back between two starts of a node, the
    new incarnation compares as the earlier one; readers take it all the same once the other is
    silent.
    """
    return f"{time.time_ns():020d}-{secrets.token_hex(_RANDOM_BYTES)}"


def encode(message: GraphMessage) -> bytes:
    """Return a message as one JSON object in UTF-8."""
    plain = codec.to_plain(message)
    assert isinstance(plain, dict)
    document: bytes = codec.to_json({"version": VERSION, "kind": message.kind.value, **plain})
    return document


def decode(data: bytes | str) -> GraphMessage:
    """Return the message that `data` holds; fields that it has besides are passed over.

    Raises:
        GraphMessageError: it is none, or of another version.
    """
    if len(data) > LONGEST_MESSAGE_BYTES:
        raise GraphMessageError(
            f"cannot read a graph message of {len(data)} bytes; at most {LONGEST_MESSAGE_BYTES}"
        )
    try:
        head = codec.from_json(data, _Head)
        if head.version != VERSION or head.kind not in _TYPES:
            raise GraphMessageError(
                f"cannot read a graph message of version {head.version} and kind {head.kind!r};"
                f" known are version {VERSION} and {', '.join(_TYPES)}"
            )
        return codec.from_json(data, _TYPES[head.kind])
    except ValueError as error:
        raise GraphMessageError(f"cannot read a graph message: {error}") from error


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class _Head:
    version: int
    kind: str
