"""Graph events, layer 2 of the graph interface: what happened, and who is notified.

Those of a node's state, configuration, connections and mappings are the difference between two
statuses of it, those of its endpoints the difference between two configurations. Pure.
"""

from __future__ import annotations

import enum
import logging
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TypeVar

import msgspec

from lifecycle.graph.model import GraphChange, NodeView
from lifecycle.graph.state import GraphState, Remove
from lifecycle.graph.status import MappingStatus, NodeStatus
from lifecycle.manifest.model import EndpointKind
from lifecycle.verify.observation import EndpointReport
from lifecycle.verify.outcome import ConnectionReport

_logger = logging.getLogger(__name__)

_K = TypeVar("_K")
_T = TypeVar("_T")


class EventKind(enum.Enum):
    """What happened."""

    JOINED = "joined"
    LEFT = "left"
    STATE_CHANGED = "state_changed"
    CONFIGURATION_CHANGED = "configuration_changed"
    CONNECTION_ESTABLISHED = "connection_established"
    CONNECTION_LOST = "connection_lost"
    MAPPING_ESTABLISHED = "mapping_established"  # or it has more matched endpoints
    MAPPING_LOST = "mapping_lost"  # or it has fewer matched endpoints
    SILENT = "silent"  # a node that sent statuses is not reached any more
    ALIVE = "alive"  # it is reached again
    ENDPOINT_ADDED = "endpoint_added"
    ENDPOINT_REMOVED = "endpoint_removed"
    ENDPOINT_CHANGED = "endpoint_changed"


class GraphEvent(msgspec.Struct, frozen=True, kw_only=True):
    """One thing that happened.

    Attributes:
        view: the node that it happened to, after it; before it if it left.
        reason: for people; empty if there is none.
        connection: for the two CONNECTION kinds; as it is now, or was.
        mapping: for the two MAPPING kinds; as it is now, or was.
        endpoint: for the three ENDPOINT kinds; as it is now, or was.
    """

    kind: EventKind
    view: NodeView
    reason: str = ""
    connection: ConnectionReport | None = None
    mapping: MappingStatus | None = None
    endpoint: EndpointReport | None = None

    @property
    def node(self) -> str:
        """Fully qualified name of the node that it happened to."""
        return self.view.name


Callback = Callable[[GraphEvent], None]


@typing.final
class GraphEvents:
    """The events of one graph. Every method: any thread; callbacks come where the state's do."""

    def __init__(self, state: GraphState) -> None:
        self._state = state

    def on(
        self, kinds: EventKind | Iterable[EventKind], callback: Callback, *, node: str | None = None
    ) -> Remove:
        """Have `callback` called with each event of these kinds from now on.

        Args:
            kinds: one or several; `EventKind` itself for all.
            callback: an exception that it raises is logged.
            node: fully qualified; only what happens to it. None: to any.

        Returns:
            A function that takes the callback away again.
        """
        wanted = frozenset((kinds,) if isinstance(kinds, EventKind) else kinds)

        def changed(change: GraphChange) -> None:
            if node in (None, change.node):
                for event in events_of(change):
                    if event.kind in wanted:
                        _call(callback, event)

        return self._state.on_change(changed)

    def on_publisher(
        self, topic: str, appeared: Callback, vanished: Callback | None = None
    ) -> Remove:
        """Have `appeared` called with each publisher of a topic: those there are, and new ones.

        Args:
            topic: fully qualified.
            appeared: gets an ENDPOINT_ADDED event; `event.endpoint.mapped` says whether data can
                leave already.
            vanished: gets an ENDPOINT_REMOVED event; a node that left takes its endpoints along.
        """
        return self.on_endpoint(EndpointKind.PUBLISHER, topic, appeared, vanished)

    def on_endpoint(
        self, kind: EndpointKind, name: str, appeared: Callback, vanished: Callback | None = None
    ) -> Remove:
        """Have `appeared` called with each endpoint of a kind and name; as `on_publisher`."""
        callbacks = {EventKind.ENDPOINT_ADDED: appeared, EventKind.ENDPOINT_REMOVED: vanished}

        def changed(change: GraphChange) -> None:
            for event in _endpoint_events(change):
                callback = callbacks.get(event.kind)
                assert event.endpoint is not None
                if callback and (event.endpoint.kind, event.endpoint.resolved) == (kind, name):
                    _call(callback, event)

        return self._state.on_change(changed, known=True)


def _call(callback: Callback, event: GraphEvent) -> None:
    try:
        callback(event)
    except Exception:
        _logger.exception("cannot handle %s of %s", event.kind.value, event.node)


def events_of(change: GraphChange) -> Iterator[GraphEvent]:
    """Yield what happened when a node changed; a node that leaves takes its endpoints along."""
    before, after = change.before, change.after
    if after is None:
        assert before is not None
        yield from _endpoint_events(change)
        yield GraphEvent(kind=EventKind.LEFT, view=before, reason=change.reason)
        return
    if before is None:
        yield GraphEvent(kind=EventKind.JOINED, view=after)
    elif before.silent != after.silent:
        kind = EventKind.SILENT if after.silent else EventKind.ALIVE
        yield GraphEvent(kind=kind, view=after, reason=after.silent)
    if before is not None and before.status is not None and after.status is not None:
        yield from _status_events(before.status, after.status, after)
    yield from _endpoint_events(change)


def _status_events(before: NodeStatus, after: NodeStatus, view: NodeView) -> Iterator[GraphEvent]:
    """Yield the difference between two statuses of one instance."""
    if (before.state, before.connected) != (after.state, after.connected):
        yield GraphEvent(kind=EventKind.STATE_CHANGED, view=view)
    for more, connection in _differences(
        {each.name: each for each in before.connections},
        {each.name: each for each in after.connections},
        lambda each: int(each is not None and each.established),
    ):
        kind = EventKind.CONNECTION_ESTABLISHED if more else EventKind.CONNECTION_LOST
        yield GraphEvent(kind=kind, view=view, connection=connection)
    for more, mapping in _differences(
        {(each.endpoint, each.connection): each for each in before.mappings},
        {(each.endpoint, each.connection): each for each in after.mappings},
        lambda each: -1 if each is None else each.matched or 0,
    ):
        kind = EventKind.MAPPING_ESTABLISHED if more else EventKind.MAPPING_LOST
        yield GraphEvent(kind=kind, view=view, mapping=mapping)
    if before.checksum != after.checksum:
        yield GraphEvent(kind=EventKind.CONFIGURATION_CHANGED, view=view)


def _differences(
    had: Mapping[_K, _T], has: Mapping[_K, _T], rank: Callable[[_T | None], int]
) -> Iterator[tuple[bool, _T]]:
    """Yield what ranks otherwise now, as it is or was, and whether it ranks higher."""
    for key, old_or_new in {**had, **has}.items():
        before, now = rank(had.get(key)), rank(has.get(key))
        if before != now:
            yield now > before, old_or_new


def _endpoint_events(change: GraphChange) -> Iterator[GraphEvent]:
    view, endpoints = change.after or change.before, change.endpoints
    assert view is not None
    for kind, changed in (
        (EventKind.ENDPOINT_REMOVED, endpoints.removed),
        (EventKind.ENDPOINT_ADDED, endpoints.added),
        (EventKind.ENDPOINT_CHANGED, endpoints.changed),
    ):
        for each in changed:
            yield GraphEvent(kind=kind, view=view, endpoint=each)
