"""The sending side of one node: what it reports about itself to the graph.

Owns: a node's incarnation, its sequence numbers, and what its heartbeats repeat. Imports no ROS:
the transport and the timer are given.
"""

from __future__ import annotations

import logging
import threading
import typing
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from lifecycle.errors import LifecycleError
from lifecycle.graph.messages import (
    ConfigurationChanged,
    ConnectionEstablished,
    ConnectionLost,
    GraphMessage,
    Heartbeat,
    Joined,
    Left,
    MappingEstablished,
    MappingLost,
    StateChanged,
    encode,
    new_incarnation,
)
from lifecycle.graph.transport import GraphTransport

if TYPE_CHECKING:  # it imports asyncio, which a node that only reports has no use for
    from lifecycle.graph.scheduler import Remove

_logger = logging.getLogger(__name__)

HEARTBEAT_PERIOD_S = 2.0
"""Heartbeats repair what was lost; what must notice a death sooner has other means."""


@typing.final
class GraphReporter:
    """Reports to the graph what becomes of one node instance. Every method: any thread.

    Before `joined` and after `left` nothing is sent, but states and checksums are kept. A message
    that the transport does not take is logged, never raised: a node works without the graph.

    Args:
        transport: where to send; it is not closed by the reporter.
        node: fully qualified name.
        every: starts the heartbeats' timer, which calls back each so many seconds, first after one
            period, until what `every` returned is called.
        period_s: of the heartbeats, > 0.
        incarnation: of this node instance; by default a new one.
    """

    def __init__(
        self,
        transport: GraphTransport,
        node: str,
        *,
        every: Callable[[float, Callable[[], None]], Remove],
        period_s: float = HEARTBEAT_PERIOD_S,
        incarnation: str | None = None,
    ) -> None:
        self.node = node
        self.incarnation = incarnation or new_incarnation()
        self._transport = transport
        self._every = every
        self._period_s = period_s
        self._lock = threading.RLock()
        self._sequence = 0
        self._state, self._connected, self._checksum = "", False, ""
        self._stop: tuple[Remove, ...] = ()
        self._left = False

    @property
    def sequence(self) -> int:
        """Sequence number of the last message; 0 before the first."""
        return self._sequence

    @property
    def is_member(self) -> bool:
        """Whether `joined` was called and `left` was not."""
        return bool(self._stop) and not self._left

    def joined(self, state: str = "", *, connected: bool = False, checksum: str = "") -> None:
        """Become part of the graph and begin the heartbeats; once, again only says it again.

        Args:
            state: lifecycle_msgs/State label; empty for a node that is not managed.
            connected: the data layer is made.
            checksum: of the node configuration; empty if the node serves none.
        """
        with self._lock:
            self._state, self._connected, self._checksum = state, connected, checksum
            if self._left:
                return
            if not self._stop:
                self._stop = (
                    self._transport.on_peer(self.announce),
                    self._every(self._period_s, self.announce),
                )
            self._report(Joined, state=state, connected=connected, checksum=checksum)

    def left(self, reason: str = "") -> None:
        """Say farewell and stop the heartbeats; again is harmless."""
        with self._lock:
            self._report(Left, reason=reason)
            self._left = True
            for stop in self._stop:
                stop()
            self._stop = ()

    def state_changed(self, state: str, *, connected: bool) -> None:
        """Report the state and whether the data layer is made; nothing if both are known."""
        with self._lock:
            if (state, connected) == (self._state, self._connected):
                return
            self._state, self._connected = state, connected
            self._report(StateChanged, state=state, connected=connected)

    def configuration_changed(self, checksum: str) -> None:
        """Report that the configuration is to be read again; nothing if the checksum is known."""
        with self._lock:
            if checksum == self._checksum:
                return
            self._checksum = checksum
            self._report(ConfigurationChanged, checksum=checksum)

    def connection_established(self, connection: str, urls: Sequence[str] = ()) -> None:
        """Report that a connection works; `connection` is empty for the node's own participant."""
        self._report(ConnectionEstablished, connection=connection, urls=tuple(urls))

    def connection_lost(self, connection: str, urls: Sequence[str] = (), error: str = "") -> None:
        """Report that a connection was unmade (no error) or that it no longer works."""
        self._report(ConnectionLost, connection=connection, urls=tuple(urls), error=error)

    def mapping_established(
        self, endpoint: str, connection: str = "", *, matched: int | None = None
    ) -> None:
        """Report that an endpoint (`publishers/video`) is on a connection, or matched one more."""
        self._report(MappingEstablished, endpoint=endpoint, connection=connection, matched=matched)

    def mapping_lost(
        self,
        endpoint: str,
        connection: str = "",
        *,
        matched: int | None = None,
        error: str = "",
    ) -> None:
        """Report that an endpoint was taken off a connection, or lost a matched peer.

        Args:
            endpoint: `publishers/video`.
            connection: name of the connection.
            matched: None if it was taken off; else how many peers it has left.
            error: why; empty if that was asked for.
        """
        self._report(
            MappingLost, endpoint=endpoint, connection=connection, matched=matched, error=error
        )

    def announce(self) -> None:
        """Send a heartbeat now, besides those of the timer."""
        with self._lock:
            if self.is_member:
                self._send(
                    Heartbeat(
                        node=self.node,
                        incarnation=self.incarnation,
                        sequence=self._sequence,
                        state=self._state,
                        connected=self._connected,
                        checksum=self._checksum,
                    )
                )

    def _report(self, type_: type[GraphMessage], **fields: Any) -> None:
        # Under the lock until it is sent: what leaves first has the lower number.
        with self._lock:
            if not self.is_member:
                return
            self._sequence += 1
            self._send(
                type_(
                    node=self.node,
                    incarnation=self.incarnation,
                    sequence=self._sequence,
                    **fields,
                )
            )

    def _send(self, message: GraphMessage) -> None:
        try:
            self._transport.send(encode(message))
        except LifecycleError as error:
            _logger.warning("%s could not tell %s: %s", self.node, message.kind.value, error)
