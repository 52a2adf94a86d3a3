"""Who says of whom that it is silent or stuck.

Owns: the notices that members have given of each other, and when they end: their sender takes them
back, leaves, or does not repeat them in its heartbeat. Pure; not thread-safe.
"""

from __future__ import annotations

from collections.abc import Mapping

from lifecycle.graph.event import EventKind, GraphEvent, NodeLiveliness
from lifecycle.graph.messages import AliveNotice, Heartbeat, SilentNotice, StuckNotice
from lifecycle.graph.sender import Sender


class Notices:
    """The troubles of the members of one graph.

    Args:
        senders: every member by name, as they are now.
    """

    def __init__(self, senders: Mapping[str, Sender]) -> None:
        self._senders = senders
        self._given: dict[str, set[str]] = {}
        """Sender of notices → whom they are about."""

    def hold(
        self,
        node: str,
        source: str,
        liveliness: NodeLiveliness,
        reason: str,
        *,
        again: bool = False,
    ) -> list[GraphEvent]:
        """Hold what `source` says of `node`, as `Sender.trouble`; return what that changes."""
        sender = self._senders.get(node)
        if sender is None or not sender.present:
            return []
        changed = sender.trouble(source, liveliness, reason, again=again)
        return [liveliness_event(sender)] if changed else []

    def take(
        self, source: str, message: SilentNotice | StuckNotice | AliveNotice
    ) -> list[GraphEvent]:
        """Take a notice that a member gives of another."""
        self._given.setdefault(source, set()).add(message.about)
        return self.hold(message.about, source, NodeLiveliness(message.kind.value), message.reason)

    def renew(self, source: str, beat: Heartbeat) -> list[GraphEvent]:
        """Hold exactly what a member says in its heartbeat."""
        held = self._given.get(source, set())
        says = {
            **dict.fromkeys(beat.stuck, NodeLiveliness.STUCK),
            **dict.fromkeys(beat.silent, NodeLiveliness.SILENT),
        }
        if not held and not says:
            return []
        self._given[source] = set(says)
        events: list[GraphEvent] = []
        for about in (*says, *(each for each in sorted(held) if each not in says)):
            liveliness = says.get(about, NodeLiveliness.ALIVE)
            events += self.hold(about, source, liveliness, "", again=about in held)
        return events

    def end(self, source: str) -> list[GraphEvent]:
        """Take back all that a member said of others."""
        events: list[GraphEvent] = []
        for about in sorted(self._given.pop(source, ())):
            events += self.hold(about, source, NodeLiveliness.ALIVE, "")
        return events


def liveliness_event(sender: Sender) -> GraphEvent:
    """Return the event that tells how alive a member is now."""
    return GraphEvent(
        kind=EventKind(sender.liveliness.value),
        node=sender.node,
        incarnation=sender.incarnation,
        reason=sender.reason,
    )
