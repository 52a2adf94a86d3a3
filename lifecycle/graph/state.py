"""State of a ROS graph with its queries, and its events: layers 3 and 2 of the graph interface.

Owns: what is known of every node: what it said last of itself, whether discovery shows it, and its
configuration as it was read or given last.

Threads: every method may be called from any thread, and what it returns does not change afterwards.
Callbacks are called where the graph posts them, one after another, after the change is in force.

Events of a node's state, configuration, connections and mappings are the difference between two
statuses of it, those of its endpoints the difference between two configurations. Pure.
"""

from __future__ import annotations

import enum
import functools
import logging
import threading
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, TypeVar

import msgspec
from msgspec.structs import replace

from lifecycle.graph.model import End, GraphChange, Link, NodeView, links
from lifecycle.graph.status import MappingStatus, NodeStatus, mappings_of
from lifecycle.manifest.model import EndpointKind
from lifecycle.measure.sample import Measured
from lifecycle.verify.observation import (
    EndpointReport,
    HealthReport,
    NodeConfiguration,
    NodeParameters,
    Observation,
    ObservedEndpoint,
    ObservedNode,
)
from lifecycle.verify.outcome import ConnectionReport

_logger = logging.getLogger(__name__)

Remove = Callable[[], None]
"""Takes a callback away again; a second call does nothing."""

Answer = tuple[str | None, NodeConfiguration | None]
"""State and configuration of a node that was asked for them; None where it did not say."""


@typing.final
class GraphState:
    """The state of one graph.

    Args:
        post: has what it is given called, in order, where callbacks are to be called.
    """

    def __init__(self, post: Callable[[Callable[[], None]], None]) -> None:
        self._post = post
        self._lock = threading.RLock()
        self._views: dict[str, NodeView] = {}
        self._given: Mapping[str, NodeConfiguration] = {}
        self._callbacks: dict[object, Callable[[GraphChange], None]] = {}

    # -- queries

    def nodes(self) -> tuple[NodeView, ...]:
        """Return every node of the graph, silent ones included, by name."""
        with self._lock:
            return tuple(view for _, view in sorted(self._views.items()))

    def node(self, name: str) -> NodeView | None:
        """Return what is known of a node (fully qualified); None if it is not in the graph."""
        with self._lock:
            return self._views.get(name)

    def publishers_of(self, topic: str) -> tuple[End, ...]:
        """Return who publishes a topic (fully qualified)."""
        return self.endpoints(EndpointKind.PUBLISHER, topic)

    def subscriptions_of(self, topic: str) -> tuple[End, ...]:
        """Return who subscribes to a topic."""
        return self.endpoints(EndpointKind.SUBSCRIPTION, topic)

    def endpoints(self, kind: EndpointKind, name: str) -> tuple[End, ...]:
        """Return the endpoints of a kind and name (fully qualified), by node name."""
        return tuple(
            End(node=view, endpoint=each)
            for view in self.nodes()
            for each in view.endpoints
            if each.kind is kind and each.resolved == name
        )

    def flows(self, topic: str) -> tuple[Link, ...]:
        """Return each pair of ends of a topic, connected or not, and by which flow."""
        return tuple(links(topic, self.publishers_of(topic), self.subscriptions_of(topic)))

    # -- changes

    def on_change(self, callback: Callable[[GraphChange], None], *, known: bool = False) -> Remove:
        """Have `callback` called with each change from now on; an exception of it is logged.

        Args:
            callback: gets one change after another.
            known: also call it, first, with each node that is there, as if it joined.
        """
        key = object()
        with self._lock:
            self._callbacks[key] = callback
            for view in self.nodes() if known else ():
                joined = GraphChange(before=None, after=view)
                self._post(functools.partial(self._call, key, joined))

        def remove() -> None:
            with self._lock:
                self._callbacks.pop(key, None)

        return remove

    def put_status(self, status: NodeStatus) -> None:
        """Take what a node says of itself, whatever carried it here.

        A later instance takes the place of an earlier one; an earlier one is passed over, unless
        the other has left or is silent: then the wall clock was set back between the two.
        """
        with self._lock:
            view = self._views.get(status.node)
            held = None if view is None else view.status
            if status.left:
                if held is not None and held.instance == status.instance:
                    self._leave(status.node, status.reason)
                return
            if view is not None and held is not None and held.instance != status.instance:
                if status.instance < held.instance and not view.silent:
                    return
                self._leave(status.node, "restarted")
            self._set(status.node, status=status, silent="")

    def put_configuration(self, configuration: NodeConfiguration) -> None:
        """Give what was learnt of a node in another way, over a control channel say.

        For `observation` it is what the node reports until a newer one is put, the node leaves the
        graph or it is dropped.
        """
        name = configuration.name
        with self._lock:
            if self._given.get(name) != configuration:
                self._given = {**self._given, name: configuration}
            # What is counted changes all the time, and is no change of the graph.
            self._set(name, configuration=replace(configuration, measured=None))

    def drop_configuration(self, node: str) -> None:
        """Forget a node (fully qualified) whose configuration was given: it is not there now."""
        with self._lock:
            if node in self._given:
                self._given = {name: each for name, each in self._given.items() if name != node}
                self._leave(node, "its process ended")

    @property
    def given(self) -> Mapping[str, NodeConfiguration]:
        """The configurations that were put, by full node name."""
        return self._given

    def learn(self, configuration: NodeConfiguration) -> None:
        """Hold what a member answered when it was asked for its configuration."""
        with self._lock:
            if configuration.name in self._views:
                self._set(configuration.name, configuration=configuration)

    def show(self, node: str) -> None:
        """Take it that a node is there: discovery shows it."""
        with self._lock:
            self._set(node, silent="")

    def hide(self, node: str, reason: str) -> None:
        """Take it that discovery does not show a node any more.

        One that sends statuses is silent from now on: Fast DDS forgets the names of nodes that
        live. Another has left.
        """
        with self._lock:
            self._given = {name: each for name, each in self._given.items() if name != node}
            view = self._views.get(node)
            if view is None or view.status is None:
                self._leave(node, reason)
            else:
                self._set(node, silent=reason)

    def close(self) -> None:
        """Call nobody back any more; what is known stays as it is. Again is harmless."""
        with self._lock:
            self._callbacks.clear()

    def _set(self, node: str, **fields: Any) -> None:
        before = self._views.get(node)
        view = replace(before or NodeView(name=node), **fields)
        if view != before:
            self._views[node] = view
            self._notify(before, view)

    def _leave(self, node: str, reason: str) -> None:
        before = self._views.pop(node, None)
        if before is not None:
            self._notify(before, None, reason)

    def _notify(self, before: NodeView | None, after: NodeView | None, reason: str = "") -> None:
        what = GraphChange(before=before, after=after, reason=reason)
        for key in tuple(self._callbacks):
            self._post(functools.partial(self._call, key, what))

    def _call(self, key: object, what: GraphChange) -> None:
        callback = self._callbacks.get(key)
        if callback is None:
            return
        try:
            callback(what)
        except Exception:
            _logger.exception("cannot handle a change of %s", what.node)

    # -- what is judged

    def observation(
        self,
        nodes: Iterable[ObservedNode] = (),
        endpoints: tuple[ObservedEndpoint, ...] = (),
        answers: Mapping[str, Answer] = {},
        *,
        parameters: tuple[NodeParameters, ...] = (),
        health: Mapping[str, HealthReport] = {},
        measured: Measured | None = None,
    ) -> Observation:
        """Return what `lifecycle.verify` judges: what was seen, and what is given of nodes now.

        A node that has no endpoint, and so nothing that discovery shows, is there by its report.

        Args:
            nodes: of the graph, without their states.
            endpoints: of the graph.
            answers: of the nodes that were asked, by full name.
            parameters: of nodes that do not report them.
            health: what /diagnostics says of nodes, by full name.
            measured: what subscriptions of this process have counted.
        """
        given, seen = self._given, tuple(nodes)
        asked = {name: configuration for name, (_, configuration) in answers.items()}
        states = {name: state for name, (state, _) in answers.items()}
        states |= {name: each.state for name, each in given.items()}
        shown = {each.full_name for each in seen}
        bare = (each for each in given.values() if not each.endpoints and each.name not in shown)
        reported = [ObservedNode(full_name=each.name, managed=bool(each.state)) for each in bare]
        return Observation(
            nodes=tuple(
                replace(each, state=states.get(each.full_name), health=health.get(each.full_name))
                for each in (*seen, *reported)
            ),
            endpoints=endpoints,
            configurations=tuple(each for each in {**given, **asked}.values() if each is not None),
            parameters=parameters,
            measured=measured,
        )


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


def connection_events(before: NodeConfiguration, after: NodeConfiguration) -> Iterator[GraphEvent]:
    """Yield what became of a node's connections and mappings between two configurations."""
    were, are = (
        NodeStatus(
            node=each.name, instance="", connections=each.connections, mappings=mappings_of(each)
        )
        for each in (before, after)
    )
    yield from _status_events(were, are, NodeView(name=after.name, status=are, configuration=after))


def _status_events(before: NodeStatus, after: NodeStatus, view: NodeView) -> Iterator[GraphEvent]:
    """Yield the difference between two statuses of one instance."""
    if (before.state, before.connected) != (after.state, after.connected):
        yield GraphEvent(kind=EventKind.STATE_CHANGED, view=view)
    mappings = tuple(
        _differences(
            {(each.endpoint, each.connection): each for each in before.mappings},
            {(each.endpoint, each.connection): each for each in after.mappings},
            lambda each: -1 if each is None else each.matched or 0,
        )
    )
    losing = {mapping.connection for more, mapping in mappings if not more}
    for more, connection in _differences(
        {each.name: each for each in before.connections},
        {each.name: each for each in after.connections},
        lambda each: int(each is not None and each.established),
    ):
        if more:
            kind = EventKind.CONNECTION_ESTABLISHED
        elif connection.established or connection.error or connection.name in losing:
            kind = EventKind.CONNECTION_LOST
        else:
            continue  # what is mapped onto it and has no peer yet is no loss
        yield GraphEvent(kind=kind, view=view, connection=connection)
    for more, mapping in mappings:
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
    view = change.after or change.before
    assert view is not None
    for before, after in change.endpoints():
        kind = EventKind.ENDPOINT_CHANGED
        if before is None or after is None:
            kind = EventKind.ENDPOINT_ADDED if before is None else EventKind.ENDPOINT_REMOVED
        yield GraphEvent(kind=kind, view=view, endpoint=after or before)
