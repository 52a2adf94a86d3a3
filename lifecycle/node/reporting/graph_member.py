"""A managed node's reporter to the ROS graph: its publisher and heartbeat in every lifecycle state.

Owns: the reporter's place on a managed node: its publisher and its timer must work in every state,
so they do not pass the gate. What is reported is lifecycle.graph's.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rclpy.node import Node

from lifecycle.graph import DdsTransport, GraphReporter, steady_timer
from lifecycle.node.connections.connection_status import ConnectionEvent, ConnectionEventKind

if TYPE_CHECKING:
    from rclpy.callback_groups import CallbackGroup

    from lifecycle.node.lifecycle.machine import NodeState


class GraphMember:
    """Reports one node to the graph, from its construction until it is destroyed.

    Args:
        node: to report; its executor sends the heartbeats.
        group: reentrant.
    """

    def __init__(self, node: Node, group: CallbackGroup) -> None:
        ungated: Any = _Ungated(node)
        self._transport = DdsTransport(ungated, callback_group=group)
        self._reporter = GraphReporter(
            self._transport, str(node.get_fully_qualified_name()), every=steady_timer(ungated)
        )

    def joined(self, state: NodeState, checksum: str) -> None:
        """Become part of the graph."""
        self._reporter.joined(state.seen.label, connected=state.connected, checksum=checksum)

    def state_changed(self, state: NodeState) -> None:
        """Report the state that the node is in now."""
        self._reporter.state_changed(state.seen.label, connected=state.connected)

    def configuration_changed(self, checksum: str) -> None:
        """Report that the configuration is to be read again, if the checksum is another."""
        self._reporter.configuration_changed(checksum)

    def connection_event(self, event: ConnectionEvent) -> None:
        """Report what became of a connection or mapping."""
        kind = event.kind
        if kind is ConnectionEventKind.CONNECTION_ESTABLISHED:
            self._reporter.connection_established(event.connection, event.urls)
        elif kind is ConnectionEventKind.CONNECTION_LOST:
            error = "" if event.unmade else "an endpoint on it has lost its last peer"
            self._reporter.connection_lost(event.connection, event.urls, error)
        elif kind is ConnectionEventKind.MAPPING_ESTABLISHED:
            self._reporter.mapping_established(
                event.endpoint, event.connection, matched=event.peers
            )
        else:
            self._reporter.mapping_lost(event.endpoint, event.connection, matched=event.peers)

    def close(self) -> None:
        """Say farewell."""
        self._reporter.left()
        self._transport.close()


class _Ungated:
    """The node's factories as rclpy has them, without the gate."""

    def __init__(self, node: Node) -> None:
        self._node = node

    def create_publisher(self, *arguments: Any, **options: Any) -> Any:
        return Node.create_publisher(self._node, *arguments, **options)

    def create_subscription(self, *arguments: Any, **options: Any) -> Any:
        return Node.create_subscription(self._node, *arguments, **options)

    def create_timer(self, *arguments: Any, **options: Any) -> Any:
        return Node.create_timer(self._node, *arguments, **options)

    def destroy_publisher(self, publisher: Any) -> Any:
        return Node.destroy_publisher(self._node, publisher)

    def destroy_subscription(self, subscription: Any) -> Any:
        return Node.destroy_subscription(self._node, subscription)

    def destroy_timer(self, timer: Any) -> Any:
        return Node.destroy_timer(self._node, timer)
