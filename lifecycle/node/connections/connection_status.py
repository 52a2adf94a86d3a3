"""Events of connections and mappings: what is different in two configurations of a node.

See *Topological Discovery and Communication Negotiation*, "Node Interface" (introspection by
notification).
"""

from __future__ import annotations

import enum
import functools
import inspect
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import msgspec

from lifecycle.verify.observation import NodeConfiguration

if TYPE_CHECKING:
    from lifecycle.node.configuration import ConfigurationChanges
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


def events_between(
    before: NodeConfiguration, after: NodeConfiguration
) -> Iterator[ConnectionEvent]:
    """Yield what became of connections and mappings.

    What is mapped onto a connection and has no peer yet is no loss of it.
    """
    old = {each.name: each for each in before.connections if not each.error}
    new = {each.name: each for each in after.connections if not each.error}
    kinds = ConnectionEventKind

    def event(kind: ConnectionEventKind, name: str, **fields: Any) -> ConnectionEvent:
        urls = (old | new)[name].urls
        return ConnectionEvent(kind=kind, connection=name, urls=urls, **fields)

    for name in (each for each in new if each not in old):
        yield event(kinds.CONNECTION_ESTABLISHED, name)
    were, are = _mappings(before), _mappings(after)
    for endpoint, name in (each for each in were if each not in are):
        yield event(kinds.MAPPING_LOST, name, endpoint=endpoint, unmade=True)
    losing = set()
    for (endpoint, name), peers in are.items():
        more = (peers or 0) - (were.get((endpoint, name)) or 0)
        if more < 0:
            losing.add(name)
            yield event(kinds.MAPPING_LOST, name, endpoint=endpoint, peers=peers)
        elif more > 0 or (endpoint, name) not in were:
            yield event(kinds.MAPPING_ESTABLISHED, name, endpoint=endpoint, peers=peers)
    for name in (each for each in new if each in old):
        if new[name].established and not old[name].established:
            yield event(kinds.CONNECTION_ESTABLISHED, name)
        elif old[name].established and not new[name].established and name in losing:
            yield event(kinds.CONNECTION_LOST, name)
    for name in (each for each in old if each not in new):
        yield event(kinds.CONNECTION_LOST, name, unmade=True)


def _mappings(configuration: NodeConfiguration) -> dict[tuple[str, str], int | None]:
    """Return the peers of each declared endpoint that is mapped, by its spelling and connection."""
    return {
        (each.kind.spell(each.name), each.connection): each.matched
        for each in configuration.endpoints
        if each.mapped and each.name
    }


Listener = Callable[[ConnectionEvent], Any]


class ConnectionEvents:
    """Who is called when something becomes of one node's connections and mappings."""

    def __init__(self, changes: ConfigurationChanges, later: Later) -> None:
        self._changes = changes
        self._later = later
        self._listeners: dict[object, Listener] = {}
        self._before: NodeConfiguration | None = None

    def listen(self, listener: Listener) -> Callable[[], None]:
        """Call `listener`, sync or async, with each event from now on; returns what ends that."""
        if self._before is None:
            self._before = self._changes.collect()
            self._changes.listen(self._look)
        key = object()
        self._listeners[key] = listener

        def remove() -> None:
            self._listeners.pop(key, None)

        return remove

    def _look(self, after: NodeConfiguration) -> None:
        before, self._before = self._before, after
        for event in events_between(before, after) if before is not None else ():
            for listener in tuple(self._listeners.values()):
                if inspect.iscoroutinefunction(listener):
                    self._later(functools.partial(listener, event))
                else:
                    listener(event)
