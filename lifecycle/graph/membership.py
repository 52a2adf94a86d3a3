"""Who is a member of the graph, and what each message of it means.

Owns: joining, leaving and restarting; the order in which the messages of a node count, and how long
a missing one is waited for; and what follows when nothing is heard. Events come out of it; who is
told of them is events.py's to say.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Iterable

from lifecycle.graph.deadlines import Deadlines
from lifecycle.graph.endpoints import EndpointIndex
from lifecycle.graph.event import EventKind, GraphEvent, Member, NodeLiveliness
from lifecycle.graph.messages import (
    AliveNotice,
    GraphMessage,
    Heartbeat,
    Joined,
    Left,
    SilentNotice,
    StuckNotice,
)
from lifecycle.graph.notices import Notices, liveliness_event
from lifecycle.graph.scheduler import Scheduler
from lifecycle.graph.sender import Sender
from lifecycle.verify.observation import EndpointReport

_HERE = ""
_BEATS = "heartbeats"


class Membership:
    """The members of one graph.

    `members`, `has` and `reports` may be called from any thread; the rest in the scheduler.

    Args:
        scheduler: where everything runs.
        endpoints: of all members; those of one that leaves go with it.
        lock: held while members or endpoints change, and not while events are told.
        tell: given what happens, in order.
        silent_after_s: a node that sent messages and then none for so long is silent; > 0.
        hold_s: so long a message waits for those before it, >= 0.
        forget_after_s: a silent node counts as gone after so long, > silent_after_s.

    Attributes:
        ignored: how many messages were of an instance that is not the current one.
        closed: nobody is taken in any more.
    """

    def __init__(
        self,
        scheduler: Scheduler,
        endpoints: EndpointIndex,
        lock: threading.RLock,
        tell: Callable[[Iterable[GraphEvent]], None],
        *,
        silent_after_s: float,
        hold_s: float,
        forget_after_s: float,
    ) -> None:
        self._scheduler = scheduler
        self._endpoints = endpoints
        self._lock = lock
        self._tell = tell
        self._hold_s = hold_s
        self._silent_after_s = silent_after_s
        self._senders: dict[str, Sender] = {}
        self._notices = Notices(self._senders)
        self._beats = Deadlines(scheduler, silent_after_s, self._fell_silent)
        self._gone = Deadlines(scheduler, forget_after_s, self._forget)
        self.ignored = 0
        self.closed = False

    def members(self) -> tuple[Member, ...]:
        """Return who is part of the graph now, silent ones included."""
        with self._lock:
            return tuple(each.member for each in self._senders.values() if each.present)

    def has(self, node: str) -> bool:
        """Tell whether a node is part of the graph now."""
        with self._lock:
            sender = self._senders.get(node)
            return sender is not None and sender.present

    def reports(self, node: str) -> bool:
        """Tell whether a node is part of the graph now and sends messages."""
        with self._lock:
            sender = self._senders.get(node)
            return sender is not None and sender.present and bool(sender.incarnation)

    def hear(self, message: GraphMessage) -> None:
        """Take a message that arrived."""
        with self._lock:
            events = self._take(message)
        self._tell(events)

    def report(self, node: str, liveliness: NodeLiveliness, reason: str) -> None:
        """Take it from whoever observes here, and sends no messages, how alive a member is."""
        with self._lock:
            events = self._notices.hold(node, _HERE, liveliness, reason)
        self._tell(events)

    def seen(self, node: str) -> None:
        """Take in a node that sends no messages: discovery shows it."""
        with self._lock:
            sender = self._senders.setdefault(node, Sender(node))
            if sender.present or self.closed:
                return
            sender.begin()
            self._gone.drop(node)
        self._tell([_event(EventKind.JOINED, sender)])

    def vanished(self, node: str, reason: str) -> None:
        """Take out a node that sends no messages; one that sends some is passed over."""
        with self._lock:
            sender = self._senders.get(node)
            if sender is None or not sender.present or sender.incarnation:
                return
            events = self._end_of(sender, reason)
        self._tell(events)

    def end(self) -> None:
        """Wait for nothing any more."""
        self._beats.close()
        self._gone.close()
        for sender in self._senders.values():
            sender.cancel_wait()

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
        if sender.heard():
            events.append(liveliness_event(sender))
        for each in ready:
            # JOINED was told already, whatever the first message was.
            events += self._apply(sender, each, told=first and isinstance(each, Joined))
        return [*events, *self._wait_for_missing(sender)]

    def _begin(self, sender: Sender, message: GraphMessage) -> tuple[bool, list[GraphEvent]]:
        """Take a node's first message; return whether it joined by it, and what happened."""
        if sender.present and not sender.incarnation:
            sender.adopt(message.incarnation, message)
            return False, []
        events = self._end_of(sender, "restarted") if sender.present else []
        sender.begin(message.incarnation, message)
        return True, [*events, _event(EventKind.JOINED, sender, message)]

    def _apply(self, sender: Sender, message: GraphMessage, *, told: bool) -> list[GraphEvent]:
        """Let one message, in its turn, take effect."""
        if isinstance(message, Left):
            return self._end_of(sender, message.reason, message)
        sender.learn(message)
        if told:
            return []
        if isinstance(message, SilentNotice | StuckNotice | AliveNotice):
            return self._notices.take(sender.node, message)
        events = self._notices.renew(sender.node, message) if isinstance(message, Heartbeat) else []
        kind = EventKind.HEARTBEAT if isinstance(message, Joined) else EventKind(message.kind.value)
        return [*events, _event(kind, sender, message)]

    def _wait_for_missing(self, sender: Sender) -> list[GraphEvent]:
        if not sender.present or sender.order is None:
            return []
        if not sender.order.is_waiting:
            sender.cancel_wait()
        elif sender.order.is_full:
            return self._give_up(sender)
        elif sender.stop_waiting is None:
            sender.stop_waiting = self._scheduler.call_at(
                self._scheduler.now_s() + self._hold_s, functools.partial(self._waited, sender)
            )
        return []

    def _waited(self, sender: Sender) -> None:
        with self._lock:
            events = self._give_up(sender)
        self._tell(events)

    def _give_up(self, sender: Sender) -> list[GraphEvent]:
        sender.cancel_wait()
        assert sender.order is not None
        missing = sender.order.last + 1
        events: list[GraphEvent] = []
        for each in sender.order.give_up():
            events += self._apply(sender, each, told=False)
        if sender.present:
            # Last: who reads the node now needs nothing of the above on top of the answer.
            events.append(_event(EventKind.GAP, sender, reason=f"message {missing} was lost"))
        return events

    def _end_of(
        self, sender: Sender, reason: str, message: GraphMessage | None = None
    ) -> list[GraphEvent]:
        """Take a member out, with its endpoints and with what it noticed of others."""
        events = self._notices.end(sender.node)
        events += (
            endpoint_event(EventKind.ENDPOINT_REMOVED, sender.node, each)
            for each in self._endpoints.update(sender.node, ()).removed
        )
        events.append(_event(EventKind.LEFT, sender, message, reason))
        sender.end(for_good=message is not None)
        self._beats.drop(sender.node)
        self._gone.touch(sender.node)
        return events

    # -- what happens when nothing is heard

    def _fell_silent(self, node: str) -> None:
        with self._lock:
            self._gone.touch(node)
            reason = f"no message for {self._silent_after_s:g} s"
            events = self._notices.hold(node, _BEATS, NodeLiveliness.SILENT, reason)
        self._tell(events)

    def _forget(self, node: str) -> None:
        """Drop a node that left or fell silent long ago."""
        with self._lock:
            sender = self._senders[node]
            events = self._end_of(sender, "not heard any more") if sender.present else []
            self._gone.drop(node)
            del self._senders[node]
        self._tell(events)


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
