"""Layer 2 of the graph interface: what happens in the graph, and who is notified of it.

Owns: the subscribers by what they ask for; membership.py says what happened. Duplicates are
dropped, messages that come too early wait, and what stays missing becomes a GAP: read that node
again. A node that sends nothing any more is SILENT, and ALIVE again afterwards.

Threads: everything runs in the scheduler. Subscribers are called there, one after another, each
event to all of them before the next; so they must be quick, and may call any method here. Every
public method may be called from any thread.
"""

from __future__ import annotations

import functools
import logging
import threading
import typing
from collections.abc import Callable, Iterable, Iterator

from lifecycle.graph.membership import Membership, endpoint_event
from lifecycle.graph.messages import GraphMessage, GraphMessageError, decode
from lifecycle.graph.model import (
    EndpointChange,
    EndpointIndex,
    EventKind,
    GraphEvent,
    Member,
    NodeLiveliness,
    names_of,
)
from lifecycle.graph.scheduler import Remove, Scheduler
from lifecycle.graph.transport import GraphTransport
from lifecycle.manifest.model import EndpointKind
from lifecycle.verify.observation import EndpointReport

_logger = logging.getLogger(__name__)

About = str | tuple[EndpointKind, str] | None
"""A node, an endpoint's kind and name, or anything."""

Callback = Callable[[GraphEvent], None]


class Subscribers:
    """Callbacks of one graph. `add` from any thread; the rest from the scheduler."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._callbacks: dict[tuple[EventKind, About], tuple[tuple[object, Callback], ...]] = {}
        self._outbox: list[GraphEvent] = []
        self._notifying = False

    def add(self, wanted: Iterable[tuple[EventKind, About]], callback: Callback) -> Remove:
        """Have `callback` called with what is wanted; return what takes it away."""
        token = object()
        places = tuple(wanted)
        with self._lock:
            for place in places:
                self._callbacks[place] = (*self._callbacks.get(place, ()), (token, callback))

        def remove() -> None:
            with self._lock:
                for place in places:
                    left = tuple(
                        each for each in self._callbacks.get(place, ()) if each[0] is not token
                    )
                    if left:
                        self._callbacks[place] = left
                    else:
                        self._callbacks.pop(place, None)

        return remove

    def notify(self, events: Iterable[GraphEvent]) -> None:
        """Notify all who asked for an event of it, before the next event.

        What a callback makes happen meanwhile follows after that.
        """
        self._outbox += events
        if self._notifying:
            return
        self._notifying = True
        try:
            while self._outbox:
                event = self._outbox.pop(0)
                for place in _places(event):
                    for _, callback in self._callbacks.get(place, ()):
                        call(callback, event)
        finally:
            self._notifying = False


def call(callback: Callback, event: GraphEvent) -> None:
    """Call back; an exception is logged, and ends nothing."""
    try:
        callback(event)
    except Exception:
        _logger.exception("cannot handle %s of %s", event.kind.value, event.node)


def _places(event: GraphEvent) -> Iterator[tuple[EventKind, About]]:
    yield event.kind, None
    yield event.kind, event.node
    if event.endpoint is not None:
        for name in names_of(event.endpoint):
            yield event.kind, (event.endpoint.kind, name)


SILENT_AFTER_S = 7.0
"""Three heartbeats and a half: one or two may be lost without an alarm."""

HOLD_S = 0.2
"""What a reliable transport still delivers comes within so long."""

FORGET_AFTER_S = 600.0
"""A node that sent nothing for so long has left."""


@typing.final
class GraphEvents:
    """The events of one graph.

    Args:
        transport: where messages come from; it is not closed by `close`. None: from nowhere.
        scheduler: where everything runs.
        silent_after_s: a node that sent messages and then none for so long is silent; > 0.
        hold_s: so long a message waits for those before it, >= 0.
        forget_after_s: a silent node counts as gone after so long, > silent_after_s.
    """

    def __init__(
        self,
        transport: GraphTransport | None,
        scheduler: Scheduler,
        *,
        silent_after_s: float = SILENT_AFTER_S,
        hold_s: float = HOLD_S,
        forget_after_s: float = FORGET_AFTER_S,
    ) -> None:
        self.scheduler = scheduler
        self.endpoints = EndpointIndex()
        """Who has which endpoint, as configurations were read; hold `lock` to look."""
        self.lock = threading.RLock()
        self._malformed = 0
        self._subscribers = Subscribers()
        self._membership = Membership(
            scheduler,
            self.endpoints,
            self.lock,
            self._subscribers.notify,
            silent_after_s=silent_after_s,
            hold_s=hold_s,
            forget_after_s=forget_after_s,
        )
        self._message_callbacks: tuple[Callable[[GraphMessage], None], ...] = ()
        self._stop: Remove | None = None
        if transport is not None:
            self._stop = transport.receive(
                lambda data: scheduler.post(functools.partial(self._arrived, data))
            )

    # -- subscribing

    def on(
        self,
        kinds: EventKind | Iterable[EventKind],
        callback: Callable[[GraphEvent], None],
        *,
        node: str | None = None,
    ) -> Remove:
        """Have `callback` called with each event of these kinds from now on.

        Args:
            kinds: one or several; `EventKind` itself for all.
            callback: called in the scheduler; an exception that it raises is logged.
            node: fully qualified; only what happens to it. None: to any.

        Returns:
            A function that takes the callback away again.
        """
        wanted = (kinds,) if isinstance(kinds, EventKind) else tuple(kinds)
        return self._subscribers.add([(kind, node) for kind in wanted], callback)

    def on_message(self, callback: Callable[[GraphMessage], None]) -> None:
        """Have `callback` called in the scheduler with each message, before it is put in order."""
        self._message_callbacks += (callback,)

    def on_publisher(
        self,
        topic: str,
        appeared: Callable[[GraphEvent], None],
        vanished: Callable[[GraphEvent], None] | None = None,
    ) -> Remove:
        """Have `appeared` called with each publisher of a topic: those there are, and new ones.

        Endpoints are known where configurations are read: keep a `GraphState` on these events, or
        call `configuration_read` yourself.

        Args:
            topic: fully qualified.
            appeared: gets an ENDPOINT_ADDED event; `event.endpoint.mapped` says whether data can
                leave already.
            vanished: gets an ENDPOINT_REMOVED event; a node that left takes its endpoints along.
        """
        return self.on_endpoint(EndpointKind.PUBLISHER, topic, appeared, vanished)

    def on_subscription(
        self,
        topic: str,
        appeared: Callable[[GraphEvent], None],
        vanished: Callable[[GraphEvent], None] | None = None,
    ) -> Remove:
        """Have `appeared` called with each subscription of a topic; as `on_publisher`."""
        return self.on_endpoint(EndpointKind.SUBSCRIPTION, topic, appeared, vanished)

    def on_endpoint(
        self,
        kind: EndpointKind,
        name: str,
        appeared: Callable[[GraphEvent], None],
        vanished: Callable[[GraphEvent], None] | None = None,
    ) -> Remove:
        """Have `appeared` called with each endpoint of a kind and name; as `on_publisher`."""
        removes: list[Remove] = []

        def begin() -> None:
            # In one turn of the scheduler, so that none comes twice and none is left out.
            if removes:
                return
            with self.lock:
                known = [
                    endpoint_event(EventKind.ENDPOINT_ADDED, each.node, each.endpoint)
                    for each in self.endpoints.named(kind, name)
                ]
            removes.append(
                self._subscribers.add([(EventKind.ENDPOINT_ADDED, (kind, name))], appeared)
            )
            if vanished is not None:
                removes.append(
                    self._subscribers.add([(EventKind.ENDPOINT_REMOVED, (kind, name))], vanished)
                )
            for event in known:
                call(appeared, event)

        def remove() -> None:
            removes.append(lambda: None)
            for each in removes:
                each()

        self.scheduler.post(begin)
        return remove

    @property
    def ignored(self) -> int:
        """How many messages were malformed, or of an instance that is not the current one."""
        return self._malformed + self._membership.ignored

    def members(self) -> tuple[Member, ...]:
        """Return who is part of the graph now, silent ones included."""
        return self._membership.members()

    def reports(self, node: str) -> bool:
        """Tell whether `node` is part of the graph now and sends messages."""
        return self._membership.reports(node)

    # -- what is noticed otherwise

    def report_silent(self, node: str, reason: str = "") -> None:
        """Take `node` for silent, until a message of it comes or `report_alive`.

        For what notices sooner than by missing heartbeats: DDS liveliness, a pidfd. A
        node that is not a member is passed over.
        """
        self._report(node, NodeLiveliness.SILENT, reason)

    def report_stuck(self, node: str, reason: str = "") -> None:
        """Take it that `node` is there and does not do its work, until `report_alive`."""
        self._report(node, NodeLiveliness.STUCK, reason)

    def report_alive(self, node: str, reason: str = "") -> None:
        """Take back what was reported here of `node`."""
        self._report(node, NodeLiveliness.ALIVE, reason)

    def report_seen(self, node: str) -> None:
        """Take it that `node` is there although it sends no messages: discovery shows it."""
        self.scheduler.post(functools.partial(self._membership.seen, node))

    def report_gone(self, node: str, reason: str = "") -> None:
        """Take back `report_seen`.

        A node that sends messages is passed over: Fast DDS forgets the names of nodes that live.
        """
        self.scheduler.post(functools.partial(self._membership.vanished, node, reason))

    def configuration_read(self, node: str, endpoints: Iterable[EndpointReport]) -> EndpointChange:
        """Take what a node's configuration says of its endpoints, and notify of what is new.

        To be called in the scheduler. A node that is not a member has no endpoints.
        """
        with self.lock:
            change = self.endpoints.update(node, endpoints if self._membership.has(node) else ())
        self._subscribers.notify(
            endpoint_event(kind, node, each)
            for kind, changed in (
                (EventKind.ENDPOINT_REMOVED, change.removed),
                (EventKind.ENDPOINT_ADDED, change.added),
                (EventKind.ENDPOINT_CHANGED, change.changed),
            )
            for each in changed
        )
        return change

    def close(self) -> None:
        """Stop listening. What was begun may still follow; again is harmless."""
        self._membership.closed = True
        if self._stop is not None:
            self._stop()
        self.scheduler.post(self._membership.end)

    # -- what happens in the scheduler

    def _arrived(self, data: bytes) -> None:
        if self._membership.closed:
            return
        try:
            message = decode(data)
        except GraphMessageError as error:
            self._malformed += 1
            _logger.info("passed over: %s", error)
            return
        for callback in self._message_callbacks:
            callback(message)
        self._membership.take(message)

    def _report(self, node: str, liveliness: NodeLiveliness, reason: str) -> None:
        self.scheduler.post(functools.partial(self._membership.report, node, liveliness, reason))
