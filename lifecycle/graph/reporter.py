"""Sending and receiving node statuses over DDS, layer 1 of the graph interface.

One JSON document in each message. DDS keeps the last status of each node for who comes later, sends
again what was lost, and delivers a writer's statuses in their order.
"""

from __future__ import annotations

import logging
import threading
import typing
from collections.abc import Callable
from typing import Any

import msgspec
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from std_msgs.msg import String

from lifecycle.graph.status import (
    NodeStatus,
    NodeStatusError,
    decode,
    encode,
    mappings_of,
    new_instance,
)
from lifecycle.middleware.rcl.conversions import latched
from lifecycle.verify.observation import NodeConfiguration
from lifecycle.verify.tool_filter import GRAPH_TOPIC

_logger = logging.getLogger(__name__)


STATUS_QOS = latched(1)
"""Of who sends: the last status is the state."""

_FAREWELL_S = 0.2
"""Receivers acknowledge the last status within milliseconds; those that are gone never do."""

_RECEIVING_QOS = latched(1000)
"""Of who receives: the statuses of all nodes arrive at once when it comes."""


@typing.final
class GraphReporter:
    """Reports one node to the graph from the first `report` until `left`. Every method: any thread.

    A status that the RMW does not take is logged, never raised: a node works without the graph.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._lock = threading.Lock()
        name = str(node.get_fully_qualified_name())
        self._status = NodeStatus(node=name, instance=new_instance())
        self._reported = False
        # rclpy's own factory: that of a LifecycleNode makes publishers that pass its gate.
        self._publisher: Publisher | None = Node.create_publisher(
            node,
            String,
            GRAPH_TOPIC,
            STATUS_QOS,
            event_callbacks=PublisherEventCallbacks(use_default_callbacks=False),
        )

    def report(self, **changes: Any) -> None:
        """Report fields of `NodeStatus`, and what was reported before of the rest.

        Nothing is sent if all of it is known. After `left` it goes nowhere.
        """
        with self._lock:
            status = msgspec.structs.replace(self._status, **changes)
            if self._reported and status == self._status:
                return
            self._status, self._reported = status, True
            self._send(status)

    def report_configuration(self, configuration: NodeConfiguration) -> None:
        """Report what a configuration says of checksum, connections and mappings."""
        self.report(
            checksum=configuration.checksum,
            connections=configuration.connections,
            mappings=mappings_of(configuration),
        )

    def left(self, reason: str = "") -> None:
        """Say farewell; again is harmless. To be called before the node is destroyed."""
        with self._lock:
            publisher = self._publisher
            if publisher is None:
                return
            if self._reported:
                self._send(msgspec.structs.replace(self._status, left=True, reason=reason))
            self._publisher = None
        # What has not arrived goes with its publisher.
        publisher.wait_for_all_acked(Duration(seconds=_FAREWELL_S))
        Node.destroy_publisher(self._node, publisher)

    def _send(self, status: NodeStatus) -> None:
        # Under the lock: what leaves last is the newest.
        if self._publisher is None:
            return
        try:
            self._publisher.publish(String(data=encode(status).decode()))
        except Exception as error:  # noqa: BLE001 - rclpy has no root of its own errors
            _logger.warning("%s could not report its status: %s", status.node, error)


def receive(node: Node, callback: Callable[[NodeStatus], None]) -> Callable[[], None]:
    """Have `callback` called with the status of each node and with each later one.

    It is called in the executor that spins `node`. Returns what ends it, before the node is
    destroyed.
    """

    def arrived(message: String) -> None:
        try:
            status = decode(message.data)
        except NodeStatusError as error:
            _logger.info("passed over: %s", error)
            return
        callback(status)

    subscription = Node.create_subscription(
        node,
        String,
        GRAPH_TOPIC,
        arrived,
        _RECEIVING_QOS,
        callback_group=MutuallyExclusiveCallbackGroup(),
        event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
    )
    return lambda: Node.destroy_subscription(node, subscription)
