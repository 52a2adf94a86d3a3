"""The node interface as a node's own code uses it; remote_interface.py is the same for others.

Owns: the signatures. What they do is in node_interface.py. See *Topological Discovery and
Communication Negotiation*, "Node Interface".
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.task import Future

from lifecycle.network.connection_url import ConnectionUrl
from lifecycle.node.author.managed import Managed
from lifecycle.node.connections.connection_events import ConnectionEvent
from lifecycle.node.connections.connections import Connection, connections_of
from lifecycle.node.reporting import configuration
from lifecycle.verify.observation import ConnectionReport


class LocalInterface(Node):  # type: ignore[misc]  # rclpy is not typed
    """Makes connections and maps endpoints onto them, in callbacks from on_configure to cleanup."""

    lifecycle: Managed

    def connect_to(self, *urls: str | ConnectionUrl, name: str = "") -> Connection:
        """Make a connection that endpoints can be mapped onto: a DDS participant of its own.

        Args:
            urls: its transports, `udpv4://10.77.0.1:7911?peer=10.77.0.2:7910`; at least one.
            name: letters, digits and underscores; empty makes one up.

        Returns:
            The connection; the present one if it has these URLs.

        Raises:
            ConnectError: not a URL, not a name, in use for other URLs, or the middleware refused.
            NotConfiguredError: not in this state.

        Example:
            >>> net = self.connect_to("udpv4://10.77.0.1:7911", name="net")
            >>> self.map_to("video", net)
        """
        return self.lifecycle.interface.connect_to(name, connections_of(urls))

    def map_to(self, endpoint: str, connection: Connection | str) -> Future:
        """Map a declared endpoint onto a connection, or hand it over from where it is.

        A handover makes before it breaks: an endpoint that has peers lives on both connections
        until the new one has as many, at most 4 s; nothing is lost and nothing is delivered twice.
        `self.publisher(name)` stays the same handle; ask for clients anew with `self.client(name)`.

        Args:
            endpoint: `video`, or `publishers/video` where another kind has the name too.
            connection: what `connect_to` returned, or its name; "" is the node's own participant.

        Returns:
            Done once the endpoint is on the new connection alone; await it or ignore it.

        Raises:
            UnknownEndpointError: nothing, or more than one thing, is declared so.
            UnknownConnectionError: no such connection.
            ConnectError: it cannot be made there; where it was it still is.
            NotConfiguredError: not in this state.
        """
        return self.lifecycle.interface.map_to(endpoint, connection)

    def disconnect(self, connection: Connection | str) -> None:
        """Unmake a connection; endpoints that are still mapped onto it are then mapped nowhere.

        Raises:
            UnknownConnectionError: no such connection.
            ConnectError: it is the node's own participant.
            NotConfiguredError: not in this state.
        """
        self.lifecycle.interface.disconnect(connection)

    def remap(self, endpoint: str, name: str) -> None:
        """Give a declared endpoint another topic or service name; "" gives back its own.

        Raises:
            UnknownEndpointError: nothing, or more than one thing, is declared so.
            LifecycleError: not a name; the endpoint is as it was.
        """
        self.lifecycle.interface.remap(endpoint, name)

    def alias(self, endpoint: str, *names: str) -> None:
        """Give a publisher, subscription or service server these further names, and no others.

        Raises:
            UnknownEndpointError: nothing, or more than one thing, is declared so.
            LifecycleError: not a name, or of a kind with one name only; it is as it was.
        """
        self.lifecycle.interface.alias(endpoint, names)

    @property
    def connections(self) -> tuple[ConnectionReport, ...]:
        """Every connection as it is now, the node's own participant (with the empty name) first."""
        return configuration.connection_reports(self.lifecycle.spec, self.lifecycle.data_layer)

    @property
    def mappings(self) -> tuple[tuple[str, str | None], ...]:
        """(`publishers/video`, name of its connection) of every declared endpoint.

        The name is empty for the node's own participant, None for what is mapped nowhere.
        """
        return tuple(
            (each.spelling, each.connection.name if each.connection is not None else None)
            for each in self.lifecycle.data_layer.mappings
        )

    def on_connection_event(self, callback: Callable[[ConnectionEvent], Any]) -> Callable[[], None]:
        """Call back, sync or async, when a connection or mapping is established or lost.

        Returns:
            What ends it.
        """
        return self.lifecycle.connection_events.listen(callback)
