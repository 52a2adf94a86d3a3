"""Status of connections and mappings: which have peers, which are established, and its events.

Owns: the rules by which a connection counts as established or lost, every connection event and its
type, and which listener is called when: in the node's executor, in order, after the callback in
which it happened. See *Topological Discovery and Communication Negotiation*, "Node Interface"
(introspection by notification).
"""

from __future__ import annotations

import collections
import enum
import functools
import inspect
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import msgspec

from lifecycle.node.connections.connections import Connection
from lifecycle.node.endpoints.endpoint import Endpoint, Key, count_peers

if TYPE_CHECKING:
    from lifecycle.node.lifecycle.gate import Later


class ConnectionEventKind(enum.Enum):
    """What happened."""

    CONNECTION_ESTABLISHED = "connection_established"
    CONNECTION_LOST = "connection_lost"
    MAPPING_ESTABLISHED = "mapping_established"
    MAPPING_LOST = "mapping_lost"


class ConnectionEvent(msgspec.Struct, frozen=True, kw_only=True):
    """One thing that became of a connection or of a mapping.

    A connection is *established* when it was made, and again when every topic endpoint on it has a
    matched peer after that was not so; *lost* when one has lost its last peer, or it was removed. A
    mapping is *established* when it was made and with each peer that is matched, *lost* with each
    peer that is no longer, and when it was removed.

    Attributes:
        connection: name; empty for the node's own participant.
        urls: of the connection, as text.
        endpoint: `publishers/video` for the two kinds of mapping events; else empty.
        peers: matched endpoints after it; None for a mapping without a count (services, actions),
            for connections, and for what was removed.
        unmade: it was taken away on purpose: it does not exist any more.
    """

    kind: ConnectionEventKind
    connection: str
    urls: tuple[str, ...] = ()
    endpoint: str = ""
    peers: int | None = None
    unmade: bool = False


Listener = Callable[[ConnectionEvent], Any]


class ConnectionEvents:
    """What becomes of one node's connections and mappings, and who is called then.

    Args:
        later: runs a function, sync or async, in the node's executor.
        endpoints: every declared endpoint, as it is at any time.
    """

    def __init__(self, later: Later, endpoints: Mapping[Key, Endpoint]) -> None:
        self._later = later
        self._endpoints = endpoints
        self._listeners: dict[object, Listener] = {}
        self._waiting: collections.deque[ConnectionEvent] = collections.deque()
        self._established: set[str] = set()

    def listen(self, listener: Listener) -> Callable[[], None]:
        """Call `listener`, sync or async, with each event from now on; returns what ends that."""
        key = object()
        self._listeners[key] = listener

        def remove() -> None:
            self._listeners.pop(key, None)

        return remove

    def notify(self, event: ConnectionEvent) -> None:
        """Have the listeners called soon."""
        if self._listeners:
            self._waiting.append(event)  # rclpy's executor runs the newest task first
            self._later(self._deliver)

    def _deliver(self) -> None:
        while self._waiting:
            event = self._waiting.popleft()
            for listener in tuple(self._listeners.values()):
                if inspect.iscoroutinefunction(listener):
                    self._later(functools.partial(listener, event))
                else:
                    listener(event)

    def opened(self, connection: Connection) -> None:
        """A connection was made, or is there already."""
        self._judge(connection, lost=False)

    def closed(self, connection: Connection) -> None:
        """A connection with a name was removed."""
        self._established.discard(connection.name)
        self._report(ConnectionEventKind.CONNECTION_LOST, connection, unmade=True)

    def mapped(self, endpoint: Endpoint) -> None:
        """An endpoint was mapped."""
        assert endpoint.connection is not None
        self._count(endpoint)
        self._report(ConnectionEventKind.MAPPING_ESTABLISHED, endpoint.connection, endpoint)
        self._judge(endpoint.connection, lost=False)

    def unmapped(self, endpoint: Endpoint, connection: Connection) -> None:
        """An endpoint was taken off a connection."""
        self._report(ConnectionEventKind.MAPPING_LOST, connection, endpoint, unmade=True)

    def matched(self, endpoint: Endpoint) -> None:
        """Count the peers of a mapping again, and notify if they are more or fewer."""
        before = endpoint.peers or 0
        self._count(endpoint)
        now, connection = endpoint.peers or 0, endpoint.connection
        if connection is None or now == before:
            return
        kind = ConnectionEventKind.MAPPING_ESTABLISHED
        if now < before:
            kind = ConnectionEventKind.MAPPING_LOST
        self._report(kind, connection, endpoint)
        self._judge(connection, lost=now < before)

    def _count(self, endpoint: Endpoint) -> None:
        if endpoint.kind.is_topic and endpoint.placement is not None:
            endpoint.peers = count_peers(endpoint.placement.entity)

    def _report(
        self,
        kind: ConnectionEventKind,
        connection: Connection,
        endpoint: Endpoint | None = None,
        *,
        unmade: bool = False,
    ) -> None:
        self.notify(
            ConnectionEvent(
                kind=kind,
                connection=connection.name,
                urls=connection.urls,
                endpoint="" if endpoint is None else endpoint.spelling,
                peers=None if endpoint is None or unmade else endpoint.peers,
                unmade=unmade,
            )
        )

    def _judge(self, connection: Connection, *, lost: bool) -> None:
        """Notify that a connection is established, or no longer.

        What is mapped onto it and has no peer yet is no loss, and is not reported. The node's own
        participant is no connection before something is mapped onto it.
        """
        on = [
            each
            for each in self._endpoints.values()
            if each.connection is not None and each.connection.name == connection.name
        ]
        established = bool(connection.name or on) and all(
            each.peers for each in on if each.kind.is_topic
        )
        if established == (connection.name in self._established):
            return
        if established:
            self._established.add(connection.name)
            self._report(ConnectionEventKind.CONNECTION_ESTABLISHED, connection)
        else:
            self._established.discard(connection.name)
            if lost:
                self._report(ConnectionEventKind.CONNECTION_LOST, connection)
