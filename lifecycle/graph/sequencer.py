"""Putting the messages of one node instance back in order.

Owns: what is a duplicate, what came too early, and what is missing. Pure; no time: whoever uses it
decides how long to wait for what is missing.
"""

from __future__ import annotations

from lifecycle.graph.messages import GraphMessage, Heartbeat

WINDOW = 64
"""So many messages that came too early are held; then what is missing counts as lost. The depth of
the graph topic's QoS: what a writer no longer has, it cannot send again."""


class Sequencer:
    """Orders the messages of one incarnation.

    Args:
        first: the first message that was heard, whatever its number: what came before is unknown.
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
