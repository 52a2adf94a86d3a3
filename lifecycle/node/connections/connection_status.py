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

from lifecycle.node.connections.connections import Connection, Connections
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
    """The listeners of one node's connection events."""

    def __init__(self, later: Later) -> None:
        self._later = later
        self._listeners: dict[object, Listener] = {}
        self._waiting: collections.deque[ConnectionEvent] = collections.deque()

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


class ConnectionStatus:
    """The status of one node's connections and mappings.

    Args:
        connections: of the node.
        endpoints: every declared endpoint, as it is at any time.
        notify: called with each event.
    """

    def __init__(
        self,
        connections: Connections,
        endpoints: Mapping[Key, Endpoint],
        notify: Callable[[ConnectionEvent], None],
    ) -> None:
        self._connections = connections
        self._endpoints = endpoints
        self._notify = notify
        self._established: set[Connection] = set()

    def on(self, connection: Connection) -> tuple[Endpoint, ...]:
        """Return what is mapped onto a connection; flows of their own are the node's own."""
        known = self._known(connection)
        return tuple(
            endpoint
            for endpoint in self._endpoints.values()
            if endpoint.connection is not None and self._known(endpoint.connection) is known
        )

    def established(self, connection: Connection) -> bool:
        """Return whether a connection exists and every topic endpoint on it has a peer."""
        topics = (each for each in self.on(connection) if each.kind.is_topic)
        return not connection.error and all(each.peers for each in topics)

    def opened(self, connection: Connection) -> None:
        """A connection was made, or is there already."""
        self._judge(connection, lost=False)

    def closed(self, connection: Connection) -> None:
        """A connection with a name was removed."""
        self._established.discard(connection)
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
        now = endpoint.peers or 0
        if endpoint.connection is None or now == before:
            return
        kind = ConnectionEventKind.MAPPING_ESTABLISHED
        if now < before:
            kind = ConnectionEventKind.MAPPING_LOST
        self._report(kind, endpoint.connection, endpoint)
        self._judge(endpoint.connection, lost=now < before)

    def _known(self, connection: Connection) -> Connection:
        """Return the connection as which others know it."""
        return connection if connection.name else self._connections.own

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
        self._notify(
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

        What is mapped onto it and has no peer yet is no loss, and is not reported.
        """
        known = self._known(connection)
        is_own_and_empty = known is self._connections.own and not self.on(known)
        established = self.established(known) and not is_own_and_empty
        if established == (known in self._established):
            return
        kind = ConnectionEventKind.CONNECTION_ESTABLISHED
        if established:
            self._established.add(known)
        else:
            self._established.discard(known)
            kind = ConnectionEventKind.CONNECTION_LOST
        if established or lost:
            self._report(kind, known)
