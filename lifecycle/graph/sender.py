"""What is held of one member of the graph: its order, its state and its troubles.

Owns: the bookkeeping of one node for `GraphEvents`. Pure; not thread-safe.
"""

from __future__ import annotations

from collections import deque

from lifecycle.graph.event import Member, NodeLiveliness
from lifecycle.graph.messages import (
    ConfigurationChanged,
    GraphMessage,
    Heartbeat,
    Joined,
    Left,
    StateChanged,
)
from lifecycle.graph.sequencer import Sequencer
from lifecycle.graph.transport import Remove

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
        self._troubles: dict[str, tuple[NodeLiveliness, str]] = {}
        self._overruled: set[str] = set()

    def begin(self, incarnation: str = "", first: GraphMessage | None = None) -> None:
        """Be another instance from now on, or the first one; without a message, as discovered."""
        self.cancel_wait()
        self.incarnation = incarnation
        self.present = True
        self.order = None if first is None else Sequencer(first)
        self._state = self._connected = self._checksum = None
        self._troubles, self._overruled = {}, set()

    def adopt(self, incarnation: str, first: GraphMessage) -> None:
        """Send messages from now on, having been seen by discovery only."""
        self.incarnation = incarnation
        self.order = Sequencer(first)

    def end(self, *, for_good: bool) -> None:
        """Be no member any more. `for_good`: this incarnation said so, and does not come back."""
        self.cancel_wait()
        self.present = False
        self._troubles, self._overruled = {}, set()
        if for_good and self.incarnation:
            self.departed.append(self.incarnation)

    def is_next(self, message: GraphMessage) -> bool:
        """Tell whether a message of another instance, or of one that left, begins the next one.

        The later incarnation wins. An earlier one only comes forth when the later is not heard any
        more: then the wall clock was set back between the two.
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
        """Keep what a message, in its turn, tells of state and checksum."""
        if isinstance(message, Joined | Heartbeat | StateChanged):
            self._state, self._connected = message.state, message.connected
        if isinstance(message, Joined | Heartbeat | ConfigurationChanged):
            self._checksum = message.checksum

    def trouble(
        self, source: str, liveliness: NodeLiveliness, reason: str, *, again: bool = False
    ) -> bool:
        """Hold what `source` says of us; ALIVE takes it back. Return whether our state changed.

        Args:
            source: who says so.
            liveliness: what it says.
            reason: for people.
            again: it has said so before: then it counts only if we were not heard meanwhile.
        """
        before = self.liveliness
        if again and source in self._overruled and liveliness is NodeLiveliness.SILENT:
            return False
        self._overruled.discard(source)
        if liveliness is NodeLiveliness.ALIVE:
            self._troubles.pop(source, None)
        else:
            held, text = self._troubles.get(source, (None, ""))
            self._troubles[source] = (liveliness, reason or (text if held is liveliness else ""))
        return self.liveliness is not before

    def heard(self) -> bool:
        """Be not silent, whoever says so: we heard of it. Return whether that is a change."""
        before = self.liveliness
        if before is not NodeLiveliness.SILENT:
            return False
        silent = {
            source
            for source, (liveliness, _) in self._troubles.items()
            if liveliness is NodeLiveliness.SILENT
        }
        self._overruled |= silent
        for source in silent:
            del self._troubles[source]
        return True

    @property
    def liveliness(self) -> NodeLiveliness:
        """The worst that anybody says of it."""
        if not self._troubles:
            return NodeLiveliness.ALIVE
        held = {liveliness for liveliness, _ in self._troubles.values()}
        return NodeLiveliness.SILENT if NodeLiveliness.SILENT in held else NodeLiveliness.STUCK

    @property
    def reason(self) -> str:
        """Why it is not alive; empty if it is."""
        worst = self.liveliness
        reasons = (text for held, text in self._troubles.values() if held is worst and text)
        return ", ".join(dict.fromkeys(reasons))

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
            reason=self.reason,
        )

    def cancel_wait(self) -> None:
        """Wait for no missing message any more."""
        if self.stop_waiting is not None:
            self.stop_waiting()
            self.stop_waiting = None
