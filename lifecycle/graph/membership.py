"""State of one member of the graph: message order, incarnation, liveliness.

Owns: the order in which the messages of a node count, what is a duplicate and what is missing;
which of two instances is the current one; its state, and whether it is silent. Pure; not
thread-safe.
"""

from __future__ import annotations

from collections import deque

from lifecycle.graph.messages import (
    ConfigurationChanged,
    GraphMessage,
    Heartbeat,
    Joined,
    Left,
    StateChanged,
)
from lifecycle.graph.model import EventKind, GraphEvent, Member, NodeLiveliness
from lifecycle.graph.scheduler import Remove

WINDOW = 64
"""So many messages that came too early are held; then what is missing counts as lost. The depth of
the graph topic's QoS: what a writer no longer has, it cannot send again."""


class Sequencer:
    """Orders the messages of one incarnation.

    Args:
        first: the first message that came, whatever its number: what was before is unknown.
    """

    def __init__(self, first: GraphMessage) -> None:
        beats = isinstance(first, Heartbeat)
        self.last = first.sequence if beats else first.sequence - 1
        """Number of the last message that was handed on."""
        self._held: dict[int, GraphMessage] = {}
        self._beat: Heartbeat | None = None

    @property
    def is_waiting(self) -> bool:
        """Whether something is missing before what has come."""
        return bool(self._held) or self._beat is not None

    @property
    def is_full(self) -> bool:
        """Whether too much is held to wait any longer."""
        return len(self._held) >= WINDOW

    def take(self, message: GraphMessage) -> tuple[GraphMessage, ...] | None:
        """Return what may be handed on now, in order; None if the message says nothing new.

        A heartbeat older than what was handed on says nothing; one that is ahead waits.
        """
        if isinstance(message, Heartbeat):
            if message.sequence < self.last:
                return None
            if message.sequence == self.last:
                return (message,)
            if self._beat is None or message.sequence >= self._beat.sequence:
                self._beat = message
            return ()
        if message.sequence <= self.last or message.sequence in self._held:
            return None
        self._held[message.sequence] = message
        return self._ready()

    def give_up(self) -> tuple[GraphMessage, ...]:
        """Count what is missing as lost, and return all that was held, in order."""
        found: list[GraphMessage] = []
        while self._held:
            self.last = min(self._held) - 1
            found += self._ready()
        if self._beat is not None:
            found.append(self._beat)
            self.last, self._beat = self._beat.sequence, None
        return tuple(found)

    def _ready(self) -> tuple[GraphMessage, ...]:
        found: list[GraphMessage] = []
        while (message := self._held.pop(self.last + 1, None)) is not None:
            found.append(message)
            self.last += 1
        if self._beat is not None and self._beat.sequence <= self.last:
            if self._beat.sequence == self.last:
                found.append(self._beat)
            self._beat = None
        return tuple(found)


_REMEMBERED = 8
"""Incarnations that left and whose late messages must not bring them back."""


class Sender:
    """One member of the graph, or one that was."""

    def __init__(self, node: str) -> None:
        self.node = node
        self.incarnation = ""
        self.present = False
        """It joined and did not leave."""
        self.order: Sequencer | None = None
        """None while it has sent nothing."""
        self.stop_waiting: Remove | None = None
        """Cancels the wait for a missing message; None if there is none."""
        self.departed: deque[str] = deque(maxlen=_REMEMBERED)
        self._state: str | None = None
        self._connected: bool | None = None
        self._checksum: str | None = None
        self.silent = ""
        """Why it is silent; empty if it is alive."""

    def begin(self, incarnation: str = "", first: GraphMessage | None = None) -> None:
        """Be another instance from now on, or the first one; without a message, as discovered."""
        self.cancel_wait()
        self.incarnation = incarnation
        self.present = True
        self.order = None if first is None else Sequencer(first)
        self._state = self._connected = self._checksum = None
        self.silent = ""

    def adopt(self, incarnation: str, first: GraphMessage) -> None:
        """Send messages from now on, having been seen by discovery only."""
        self.incarnation = incarnation
        self.order = Sequencer(first)

    def end(self, *, for_good: bool) -> None:
        """Be no member any more. `for_good`: this incarnation said so, and does not come back."""
        self.cancel_wait()
        self.present = False
        self.silent = ""
        if for_good and self.incarnation:
            self.departed.append(self.incarnation)

    def is_next(self, message: GraphMessage) -> bool:
        """Whether a message of another instance, or of one that left, begins the next one.

        The later incarnation wins. An earlier one is taken only when the later has fallen
        silent: then the wall clock was set back between the two.
        """
        if isinstance(message, Left):
            self.departed.append(message.incarnation)
            return False
        if message.incarnation in self.departed:
            return False
        if not self.present or message.incarnation > self.incarnation:
            return True
        return self.liveliness is NodeLiveliness.SILENT

    def learn(self, message: GraphMessage) -> None:
        """Keep the state and checksum of a message whose turn it is."""
        if isinstance(message, Joined | Heartbeat | StateChanged):
            self._state, self._connected = message.state, message.connected
        if isinstance(message, Joined | Heartbeat | ConfigurationChanged):
            self._checksum = message.checksum

    @property
    def liveliness(self) -> NodeLiveliness:
        """Whether messages of it come."""
        return NodeLiveliness.SILENT if self.silent else NodeLiveliness.ALIVE

    @property
    def member(self) -> Member:
        """What is known of it."""
        return Member(
            node=self.node,
            incarnation=self.incarnation,
            state=self._state,
            connected=self._connected,
            checksum=self._checksum,
            liveliness=self.liveliness,
            reason=self.silent,
        )

    def cancel_wait(self) -> None:
        """Wait for no missing message any more."""
        if self.stop_waiting is not None:
            self.stop_waiting()
            self.stop_waiting = None


def liveliness_event(sender: Sender) -> GraphEvent:
    """Return the event of how alive a member is now."""
    return GraphEvent(
        kind=EventKind(sender.liveliness.value),
        node=sender.node,
        incarnation=sender.incarnation,
        reason=sender.silent,
    )
