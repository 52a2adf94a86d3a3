"""What `GraphState` holds of one node while its configuration comes and goes.

Owns: when a configuration must be read (again), and what it means when messages arrive while it is
being read: the answer may be older or newer than they are, so they are applied on top of it once
more. Pure; not thread-safe.
"""

from __future__ import annotations

import dataclasses

from lifecycle.graph.event import EventKind, GraphEvent, Member, NodeLiveliness
from lifecycle.graph.messages import (
    ConfigurationChanged,
    GraphMessage,
    Heartbeat,
    Joined,
    StateChanged,
)
from lifecycle.graph.view import NodeView, altered, kept
from lifecycle.verify.observation import NodeConfiguration

_LIVELINESS = {
    EventKind.SILENT: NodeLiveliness.SILENT,
    EventKind.STUCK: NodeLiveliness.STUCK,
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
        """Hold a configuration that was read or given, and what has been told since it was asked.

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
                # Discovery had shown it already; now it speaks for itself.
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
