"""State of the ROS graph and its queries: layer 3 of the graph interface.

Owns: what is known of every node, kept true by events, and re-read from a node only when the
checksum that it announces is not the one that is held, or when messages of it were lost. One change
costs work in proportion to the node that changed, a query in proportion to its answer.

Threads: the state changes in the scheduler of its events, and subscribers are called there. Every
public method may be called from any thread, and what it returns does not change afterwards.
"""

from __future__ import annotations

import functools
import logging
import threading
import typing
from collections.abc import Callable, Mapping

from lifecycle import dataclasses
from lifecycle.graph.events import GraphEvents
from lifecycle.graph.messages import (
    ConfigurationChanged,
    GraphMessage,
    Heartbeat,
    Joined,
    StateChanged,
)
from lifecycle.graph.model import (
    End,
    EndpointChange,
    EventKind,
    GraphChange,
    GraphEvent,
    Link,
    Member,
    NodeLiveliness,
    NodeView,
    Owned,
    altered,
    change,
    kept,
    link,
    match_ends,
)
from lifecycle.graph.scheduler import Remove
from lifecycle.manifest.model import EndpointKind
from lifecycle.verify.observation import (
    HealthReport,
    NodeConfiguration,
    NodeParameters,
    Observation,
    ObservedEndpoint,
    ObservedNode,
)
from lifecycle.verify.outcome import ConnectionReport

_logger = logging.getLogger(__name__)

_LIVELINESS = {
    EventKind.SILENT: NodeLiveliness.SILENT,
    EventKind.ALIVE: NodeLiveliness.ALIVE,
}


class Record:
    """One instance of one node."""

    def __init__(self, member: Member) -> None:
        self.view = NodeView(
            name=member.node,
            incarnation=member.incarnation,
            liveliness=member.liveliness,
            reason=member.reason,
            state=member.state,
            connected=member.connected,
        )
        self.reading: object | None = None
        """Token of the reading that is under way."""
        self._taken: tuple[NodeConfiguration, NodeView] | None = None
        self._announced = member.checksum
        self._doubtful = member.checksum is None
        self._again = False
        self._meanwhile: list[GraphMessage] = []

    @property
    def must_read(self) -> bool:
        """Whether what is held is not what the node announced, or may not be."""
        if self.reading is not None:
            return False
        if self._doubtful:
            return True
        held = self.view.configuration
        return bool(self._announced) and (held is None or held.checksum != self._announced)

    def doubt(self) -> None:
        """Have the configuration read again whatever its checksum."""
        if self.reading is None:
            self._doubtful = True
        else:
            self._again = True

    def holds(self, configuration: NodeConfiguration) -> bool:
        """Whether this was taken last, and nothing changed since."""
        return (
            self._taken is not None
            and self._taken[0] == configuration
            and self._taken[1] is self.view
            and self.reading is None
            and not self._doubtful
        )

    def begin(self) -> object:
        """Begin to read; return the token of this reading."""
        self._doubtful = self._again = False
        self._meanwhile = []
        self.reading = object()
        return self.reading

    def failed(self) -> None:
        """End a reading without an answer; the next heartbeat gives occasion to try again."""
        self.reading = None
        self._doubtful = True
        self._meanwhile = []

    def take(self, configuration: NodeConfiguration) -> None:
        """Hold a configuration that was read or given, and what messages said since it was asked.

        The node may have changed between its answer and a message that came before the answer: the
        checksum that was announced meanwhile, if it is another one, has it read once more.
        """
        meanwhile, self._meanwhile = self._meanwhile, []
        again, self._again = self._again, False
        self.reading = None
        self.view = dataclasses.replace(
            self.view,
            configuration=kept(configuration),
            state=configuration.state,
            connected=configuration.connected,
        )
        self._taken = configuration, self.view
        announced = False
        for message in meanwhile:
            announced |= isinstance(message, ConfigurationChanged | Heartbeat | Joined)
            self._alter(message)
        if not announced:
            self._announced = configuration.checksum
        self._doubtful = again

    def apply(self, event: GraphEvent) -> None:
        """Let an event of this node take effect."""
        if event.kind in _LIVELINESS:
            self.view = dataclasses.replace(
                self.view, liveliness=_LIVELINESS[event.kind], reason=event.reason
            )
        elif event.kind is EventKind.GAP:
            self.doubt()
        elif event.message is not None:
            if event.incarnation != self.view.incarnation:
                # Discovery had shown it already; now it reports itself.
                self.view = dataclasses.replace(self.view, incarnation=event.incarnation)
                self.doubt()
            message = event.message
            if isinstance(message, ConfigurationChanged | Heartbeat | Joined):
                self._announced = message.checksum
            if self.reading is not None:
                self._meanwhile.append(message)
            self._alter(message)

    def _alter(self, message: GraphMessage) -> None:
        view, configuration = self.view, self.view.configuration
        if isinstance(message, StateChanged | Heartbeat | Joined):
            if (view.state, view.connected) == (message.state, message.connected):
                return
            if configuration is not None:
                configuration = dataclasses.replace(
                    configuration, state=message.state, connected=message.connected
                )
            self.view = dataclasses.replace(
                view,
                configuration=configuration,
                state=message.state,
                connected=message.connected,
            )
        elif configuration is not None:
            changed = altered(configuration, message)
            if changed != configuration:
                self.view = dataclasses.replace(view, configuration=changed)


Answer = tuple[str | None, NodeConfiguration | None]
"""State and configuration of a node that was asked for them; None where it did not say."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """What was there at one moment, as `lifecycle.graph.observer` saw it.

    Attributes:
        nodes: of the graph, without their states.
        endpoints: of the graph.
        answers: of the nodes that were asked, by full name.
        parameters: of nodes that do not report them.
        health: what /diagnostics says of nodes, by full name.
    """

    nodes: tuple[ObservedNode, ...] = ()
    endpoints: tuple[ObservedEndpoint, ...] = ()
    answers: Mapping[str, Answer] = dataclasses.field(default_factory=dict)
    parameters: tuple[NodeParameters, ...] = ()
    health: Mapping[str, HealthReport] = dataclasses.field(default_factory=dict)


Fetch = Callable[[str, Callable[[NodeConfiguration | None], None]], None]
"""Reads the configuration of a node (fully qualified) and calls back once, from any thread, at once
or later; with None if it could not be read."""

_ENDPOINT_KINDS = frozenset(
    {EventKind.ENDPOINT_ADDED, EventKind.ENDPOINT_REMOVED, EventKind.ENDPOINT_CHANGED}
)


@typing.final
class GraphState:
    """The state of one graph.

    Args:
        events: layer 2; the state learns of the members that they know already. It may be shared.
        fetch: how configurations are read.
    """

    def __init__(self, events: GraphEvents, fetch: Fetch) -> None:
        self.events = events
        self._lock = threading.RLock()
        self._records: dict[str, Record] = {}
        self._given: Mapping[str, NodeConfiguration] = {}
        self._look = Look()
        self._fetch = fetch
        self._callbacks: tuple[Callable[[GraphChange], None], ...] = ()
        self._unread: set[str] = set()
        self._stop: tuple[Remove, ...] = ()
        self._closed = False
        events.scheduler.post(self._begin)

    # -- queries

    def nodes(self) -> tuple[NodeView, ...]:
        """Return every node of the graph, silent ones included, by name."""
        with self._lock:
            views = [each.view for each in self._records.values()]
        return tuple(sorted(views, key=lambda each: each.name))

    def node(self, name: str) -> NodeView | None:
        """Return what is known of a node (fully qualified); None if it is not in the graph."""
        with self._lock:
            record = self._records.get(name)
            return None if record is None else record.view

    def connections_of(self, node: str) -> tuple[ConnectionReport, ...]:
        """Return the connections of a node; none if it is not known."""
        view = self.node(node)
        return () if view is None else view.connections

    def publishers_of(self, topic: str) -> tuple[End, ...]:
        """Return who publishes a topic (fully qualified)."""
        return self.endpoints(EndpointKind.PUBLISHER, topic)

    def subscriptions_of(self, topic: str) -> tuple[End, ...]:
        """Return who subscribes to a topic."""
        return self.endpoints(EndpointKind.SUBSCRIPTION, topic)

    def endpoints(self, kind: EndpointKind, name: str) -> tuple[End, ...]:
        """Return the endpoints of a kind and name (fully qualified), by node name."""
        with self.events.lock:
            owned = self.events.endpoints.named(kind, name)
        return self._ends(owned)

    def topics(self) -> tuple[str, ...]:
        """Return every topic that is published or subscribed to, sorted."""
        with self.events.lock:
            names = {
                *self.events.endpoints.names(EndpointKind.PUBLISHER),
                *self.events.endpoints.names(EndpointKind.SUBSCRIPTION),
            }
        return tuple(sorted(names))

    def connected(self, topic: str, publisher: str, subscription: str) -> tuple[Link, ...]:
        """Return how two nodes are connected by a topic.

        Args:
            topic: fully qualified.
            publisher: fully qualified name of the publishing node.
            subscription: of the subscribing node.

        Returns:
            One link for each pair of their endpoints, usually one; none if either has no endpoint.
        """
        return self._links(
            topic,
            lambda end: end.node.name == publisher,
            lambda end: end.node.name == subscription,
        )

    def flows(self, topic: str | None = None) -> tuple[Link, ...]:
        """Return every publisher → subscription pair, connected or not, of one topic or of all."""
        topics = self.topics() if topic is None else (topic,)
        return tuple(each for name in topics for each in self._links(name, _any, _any))

    # -- changes

    def on_change(self, callback: Callable[[GraphChange], None]) -> Remove:
        """Have `callback` called in the scheduler with each change, after it is in force."""
        with self._lock:
            self._callbacks += (callback,)

        def remove() -> None:
            with self._lock:
                self._callbacks = tuple(each for each in self._callbacks if each is not callback)

        return remove

    def put_configuration(self, configuration: NodeConfiguration) -> None:
        """Give what was learnt of a node in another way, over a control channel say.

        A node that sends no messages becomes a member by it. For `observation` it is what the node
        reports until a newer one is put, the node leaves the graph or it is dropped.
        """
        name = configuration.name
        with self._lock:
            if self._given.get(name) != configuration:
                self._given = {**self._given, name: configuration}
            elif (record := self._records.get(name)) is not None and record.holds(configuration):
                return  # it is known already, and nothing came after it
        self.events.report_seen(name)
        self.events.scheduler.post(functools.partial(self._put, configuration))

    def drop_configuration(self, node: str, reason: str = "its process ended") -> None:
        """Forget what was given of a node (fully qualified) that is not there any more."""
        with self._lock:
            self._given = {name: each for name, each in self._given.items() if name != node}
        self.events.report_gone(node, reason)

    @property
    def given(self) -> Mapping[str, NodeConfiguration]:
        """The configurations that were put, by full node name."""
        return self._given

    def reread(self, node: str) -> None:
        """Have a node's configuration read again, whatever its checksum."""

        def doubt() -> None:
            record = self._records.get(node)
            if record is not None:
                record.doubt()
                self._read_if_needed(record)

        self.events.scheduler.post(doubt)

    def retry(self) -> None:
        """Read now what could not be read before: services appear later than messages arrive."""

        def again() -> None:
            for node in tuple(self._unread):
                record = self._records.get(node)
                if record is not None:
                    self._read_if_needed(record)

        self.events.scheduler.post(again)

    def close(self) -> None:
        """Follow events no longer; what is known stays as it is. Again is harmless."""
        self._closed = True
        for stop in self._stop:
            stop()

    # -- what is judged

    def put_look(self, look: Look) -> None:
        """Give what discovery and the nodes that were asked say now."""
        self._look = look

    def learn(self, configuration: NodeConfiguration) -> None:
        """Show what a member answered, where no reading of this state would bring it."""
        self.events.scheduler.post(functools.partial(self._put, configuration))

    def observation(self) -> Observation:
        """Return what `lifecycle.verify` judges: the last look, and what is given of nodes now."""
        look, given = self._look, self._given
        asked = {name: configuration for name, (_, configuration) in look.answers.items()}
        return Observation(
            nodes=tuple(
                dataclasses.replace(
                    each,
                    state=_state(each.full_name, look.answers, given),
                    health=look.health.get(each.full_name),
                )
                for each in look.nodes
            ),
            endpoints=look.endpoints,
            configurations=tuple(each for each in {**given, **asked}.values() if each is not None),
            parameters=look.parameters,
        )

    # -- what happens in the scheduler

    def _begin(self) -> None:
        if self._closed:
            return
        kinds = [each for each in EventKind if each not in _ENDPOINT_KINDS]
        self._stop = (self.events.on(kinds, self._happened),)
        for member in self.events.members():
            self._join(member)

    def _happened(self, event: GraphEvent) -> None:
        if event.kind is EventKind.JOINED:
            self._join(_member(event))
            return
        if event.kind is EventKind.LEFT:
            self._leave(event.node)
            return
        record = self._records.get(event.node)
        if record is None:
            return
        before = record.view
        with self._lock:
            record.apply(event)
        self._publish(before, record)
        self._read_if_needed(record)

    def _join(self, member: Member) -> None:
        record = Record(member)
        with self._lock:
            self._records[member.node] = record
        self._publish(None, record)
        self._read_if_needed(record)

    def _leave(self, node: str) -> None:
        with self._lock:
            record = self._records.pop(node, None)
            self._unread.discard(node)
        if record is not None:
            gone = EndpointChange(removed=record.view.endpoints)
            self._call(change(record.view, None, gone))

    def _put(self, configuration: NodeConfiguration) -> None:
        record = self._records.get(configuration.name)
        if record is not None:
            self._take(record, configuration)

    def _read_if_needed(self, record: Record) -> None:
        if not record.must_read or self._closed:
            return
        token = record.begin()
        node = record.view.name

        def done(configuration: NodeConfiguration | None) -> None:
            self.events.scheduler.post(
                functools.partial(self._answered, node, token, configuration)
            )

        self._fetch(node, done)

    def _answered(self, node: str, token: object, configuration: NodeConfiguration | None) -> None:
        record = self._records.get(node)
        if record is None or record.reading is not token:
            return  # of an instance that is gone
        if configuration is None:
            record.failed()
            self._unread.add(node)
        else:
            self._take(record, configuration)

    def _take(self, record: Record, configuration: NodeConfiguration) -> None:
        self._unread.discard(record.view.name)
        before = record.view
        with self._lock:
            record.take(configuration)
        self._publish(before, record)
        self._read_if_needed(record)

    def _publish(self, before: NodeView | None, record: Record) -> None:
        after = record.view
        if after is before:
            return
        endpoints = EndpointChange()
        if before is None or after.endpoints is not before.endpoints:
            endpoints = self.events.configuration_read(after.name, after.endpoints)
        if after != before:
            self._call(change(before, after, endpoints))

    def _call(self, what: GraphChange) -> None:
        for callback in self._callbacks:
            _logged(callback, what)

    def _links(
        self, topic: str, publishes: Callable[[End], bool], subscribes: Callable[[End], bool]
    ) -> tuple[Link, ...]:
        publishers, subscriptions = self.publishers_of(topic), self.subscriptions_of(topic)
        publishing, subscribing = match_ends(publishers), match_ends(subscriptions)
        return tuple(
            link(
                topic,
                publisher,
                subscription,
                publishers=publishing,
                subscriptions=subscribing,
            )
            for publisher in publishers
            if publishes(publisher)
            for subscription in subscriptions
            if subscribes(subscription)
        )

    def _ends(self, owned: tuple[Owned, ...]) -> tuple[End, ...]:
        found: list[End] = []
        for each in owned:
            view = self.node(each.node)
            if view is not None:
                found.append(End(node=view, endpoint=each.endpoint))
        return tuple(sorted(found, key=lambda each: each.node.name))


def _any(_: End) -> bool:
    return True


def _state(
    name: str, answers: Mapping[str, Answer], given: Mapping[str, NodeConfiguration]
) -> str | None:
    if name in given:
        return given[name].state
    return answers[name][0] if name in answers else None


def _logged(callback: Callable[[GraphChange], None], what: GraphChange) -> None:
    try:
        callback(what)
    except Exception:
        _logger.exception("cannot handle a change of %s", what.node)


def _member(event: GraphEvent) -> Member:
    message = event.message
    if isinstance(message, Joined | Heartbeat):
        return Member(
            node=event.node,
            incarnation=event.incarnation,
            state=message.state,
            connected=message.connected,
            checksum=message.checksum,
        )
    return Member(node=event.node, incarnation=event.incarnation)
