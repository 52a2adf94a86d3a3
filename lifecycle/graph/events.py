"""Graph events, layer 2 of the graph interface: nodes join, leave, restart; who is notified.

Owns: which nodes are members of the graph: joining, leaving and restarting; and the subscribers, by
what they ask for. Duplicates are dropped, messages that arrive too early wait, and what stays
missing becomes a GAP: read that node again. A node that no longer sends anything is SILENT, and
ALIVE again afterwards. What is held of each member is membership.py's.

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

from lifecycle.graph.membership import Sender, liveliness_event
from lifecycle.graph.messages import (
    GraphMessage,
    GraphMessageError,
    Joined,
    Left,
    decode,
)
from lifecycle.graph.model import (
    EndpointChange,
    EndpointIndex,
    EventKind,
    GraphEvent,
    Member,
)
from lifecycle.graph.scheduler import Deadlines, Remove, Scheduler
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
        yield event.kind, (event.endpoint.kind, event.endpoint.resolved)


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

    Attributes:
        endpoints: who has which endpoint, as configurations were read; hold `lock` to look.
        lock: held while members or endpoints change, and not while subscribers are notified.
        ignored: how many messages were malformed, or of an instance that is not the current one.
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
        self.lock = threading.RLock()
        self.ignored = 0
        self._closed = False
        self._hold_s = hold_s
        self._silent_after_s = silent_after_s
        self._subscribers = Subscribers()
        self._senders: dict[str, Sender] = {}
        self._beats = Deadlines(scheduler, silent_after_s, self._fell_silent)
        self._gone = Deadlines(scheduler, forget_after_s, self._forget)
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

    def members(self) -> tuple[Member, ...]:
        """Return who is part of the graph now, silent ones included."""
        with self.lock:
            return tuple(each.member for each in self._senders.values() if each.present)

    def reports(self, node: str) -> bool:
        """Return whether a node is part of the graph now and sends messages."""
        with self.lock:
            sender = self._senders.get(node)
            return sender is not None and sender.present and bool(sender.incarnation)

    # -- what discovery shows

    def report_seen(self, node: str) -> None:
        """Take it that `node` is there although it sends no messages: discovery shows it."""
        self.scheduler.post(functools.partial(self._seen, node))

    def report_gone(self, node: str, reason: str = "") -> None:
        """Take back `report_seen`.

        A node that sends messages is passed over: Fast DDS forgets the names of nodes that live.
        """
        self.scheduler.post(functools.partial(self._vanished, node, reason))

    def configuration_read(self, node: str, endpoints: Iterable[EndpointReport]) -> EndpointChange:
        """Take the endpoints of a node's configuration, and notify of what is new.

        To be called in the scheduler. A node that is not a member has no endpoints.
        """
        with self.lock:
            change = self.endpoints.update(node, endpoints if self._has(node) else ())
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
        self._closed = True
        if self._stop is not None:
            self._stop()
        self.scheduler.post(self._end)

    # -- what happens in the scheduler

    def _arrived(self, data: bytes) -> None:
        if self._closed:
            return
        try:
            message = decode(data)
        except GraphMessageError as error:
            self.ignored += 1
            _logger.info("passed over: %s", error)
            return
        for callback in self._message_callbacks:
            callback(message)
        self._message(message)

    def _message(self, message: GraphMessage) -> None:
        """Take a message that arrived."""
        with self.lock:
            events = self._take(message)
        self._subscribers.notify(events)

    def _seen(self, node: str) -> None:
        """Take in a node that sends no messages: discovery shows it."""
        with self.lock:
            sender = self._senders.setdefault(node, Sender(node))
            if sender.present or self._closed:
                return
            sender.begin()
            self._gone.drop(node)
        self._subscribers.notify([_event(EventKind.JOINED, sender)])

    def _vanished(self, node: str, reason: str) -> None:
        """Take out a node that sends no messages; one that sends some is passed over."""
        with self.lock:
            sender = self._senders.get(node)
            if sender is None or not sender.present or sender.incarnation:
                return
            events = self._end_of(sender, reason)
        self._subscribers.notify(events)

    def _end(self) -> None:
        """Wait for nothing any more."""
        self._beats.close()
        self._gone.close()
        for sender in self._senders.values():
            sender.cancel_wait()

    def _has(self, node: str) -> bool:
        """Return whether a node is part of the graph now."""
        with self.lock:
            sender = self._senders.get(node)
            return sender is not None and sender.present

    # -- messages, in their order

    def _take(self, message: GraphMessage) -> list[GraphEvent]:
        sender = self._senders.get(message.node)
        if sender is None:
            sender = self._senders[message.node] = Sender(message.node)
            self._gone.touch(sender.node)  # it may begin with its farewell
        events: list[GraphEvent] = []
        first = message.incarnation != sender.incarnation or not sender.present
        if first:
            if not sender.is_next(message):
                self.ignored += 1
                return []
            first, events = self._begin(sender, message)
        assert sender.order is not None
        ready = sender.order.take(message)
        if ready is None:
            return events
        self._beats.touch(sender.node)
        self._gone.drop(sender.node)
        if sender.silent:
            sender.silent = ""
            events.append(liveliness_event(sender))
        for each in ready:
            # JOINED was an event already, whatever the first message was.
            events += self._apply(sender, each, joined=first and isinstance(each, Joined))
        return [*events, *self._wait_for_missing(sender)]

    def _begin(self, sender: Sender, message: GraphMessage) -> tuple[bool, list[GraphEvent]]:
        """Take a node's first message; return whether it joined by it, and what happened."""
        if sender.present and not sender.incarnation:
            sender.adopt(message.incarnation, message)
            return False, []
        events = self._end_of(sender, "restarted") if sender.present else []
        sender.begin(message.incarnation, message)
        return True, [*events, _event(EventKind.JOINED, sender, message)]

    def _apply(self, sender: Sender, message: GraphMessage, *, joined: bool) -> list[GraphEvent]:
        """Let one message, in its turn, take effect."""
        if isinstance(message, Left):
            return self._end_of(sender, message.reason, message)
        sender.learn(message)
        if joined:
            return []
        kind = EventKind.HEARTBEAT if isinstance(message, Joined) else EventKind(message.kind.value)
        return [_event(kind, sender, message)]

    def _wait_for_missing(self, sender: Sender) -> list[GraphEvent]:
        if not sender.present or sender.order is None:
            return []
        if not sender.order.is_waiting:
            sender.cancel_wait()
        elif sender.order.is_full:
            return self._give_up(sender)
        elif sender.stop_waiting is None:
            sender.stop_waiting = self.scheduler.call_at(
                self.scheduler.now_s() + self._hold_s, functools.partial(self._waited, sender)
            )
        return []

    def _waited(self, sender: Sender) -> None:
        with self.lock:
            events = self._give_up(sender)
        self._subscribers.notify(events)

    def _give_up(self, sender: Sender) -> list[GraphEvent]:
        sender.cancel_wait()
        assert sender.order is not None
        missing = sender.order.last + 1
        events: list[GraphEvent] = []
        for each in sender.order.give_up():
            events += self._apply(sender, each, joined=False)
        if sender.present:
            # Last: who reads the node now needs nothing of the above on top of the answer.
            events.append(_event(EventKind.GAP, sender, reason=f"message {missing} was lost"))
        return events

    def _end_of(
        self, sender: Sender, reason: str, message: GraphMessage | None = None
    ) -> list[GraphEvent]:
        """Take a member out, with its endpoints."""
        events = [
            endpoint_event(EventKind.ENDPOINT_REMOVED, sender.node, each)
            for each in self.endpoints.update(sender.node, ()).removed
        ]
        events.append(_event(EventKind.LEFT, sender, message, reason))
        sender.end(for_good=message is not None)
        self._beats.drop(sender.node)
        self._gone.touch(sender.node)
        return events

    # -- what happens when no message comes

    def _fell_silent(self, node: str) -> None:
        with self.lock:
            self._gone.touch(node)
            sender = self._senders[node]
            sender.silent = f"no message for {self._silent_after_s:g} s"
        self._subscribers.notify([liveliness_event(sender)])

    def _forget(self, node: str) -> None:
        """Drop a node that left or fell silent long ago."""
        with self.lock:
            sender = self._senders[node]
            events = self._end_of(sender, "not heard any more") if sender.present else []
            self._gone.drop(node)
            del self._senders[node]
        self._subscribers.notify(events)


def _event(
    kind: EventKind, sender: Sender, message: GraphMessage | None = None, reason: str = ""
) -> GraphEvent:
    return GraphEvent(
        kind=kind,
        node=sender.node,
        incarnation=sender.incarnation,
        message=message,
        reason=reason,
    )


def endpoint_event(kind: EventKind, node: str, endpoint: EndpointReport) -> GraphEvent:
    """Return the event of an endpoint that came, went or changed."""
    return GraphEvent(kind=kind, node=node, endpoint=endpoint)
