"""What becomes of a node's connections and mappings, told as events.

Owns: the event type, who is called with it and when: in the node's executor, in order, after the
callback in which it happened. See *Topological Discovery and Communication Negotiation*, "Node
Interface" (introspection by notification).
"""

from __future__ import annotations

import collections
import dataclasses
import enum
import functools
import inspect
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lifecycle.node.lifecycle.gate import Later


class ConnectionEventKind(enum.Enum):
    """What happened."""

    CONNECTION_ESTABLISHED = "connection_established"
    CONNECTION_LOST = "connection_lost"
    MAPPING_ESTABLISHED = "mapping_established"
    MAPPING_LOST = "mapping_lost"


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ConnectionEvent:
    """One thing that became of a connection or of a mapping.

    A connection is *established* when it was made, and again when every topic endpoint on it has a
    matched peer after that was not so; *lost* when one has lost its last peer, or it was unmade. A
    mapping is *established* when it was made and with each peer that is matched, *lost* with each
    peer that is no longer, and when it was unmade.

    Attributes:
        connection: name; empty for the node's own participant.
        urls: of the connection, as text.
        endpoint: `publishers/video` for the two kinds of mapping events; else empty.
        peers: matched endpoints after it; None for a mapping without a count (services, actions),
            for connections, and for what was unmade.
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
        self._scheduled = False

    def listen(self, listener: Listener) -> Callable[[], None]:
        """Call `listener`, sync or async, with each event from now on; returns what ends that."""
        key = object()
        self._listeners[key] = listener

        def remove() -> None:
            self._listeners.pop(key, None)

        return remove

    def tell(self, event: ConnectionEvent) -> None:
        """Have the listeners called soon."""
        if not self._listeners:
            return
        self._waiting.append(event)
        if not self._scheduled:
            self._scheduled = bool(self._later(self._deliver))

    def _deliver(self) -> None:
        self._scheduled = False
        while self._waiting:
            event = self._waiting.popleft()
            for listener in tuple(self._listeners.values()):
                if inspect.iscoroutinefunction(listener):
                    self._later(functools.partial(listener, event))
                else:
                    listener(event)
