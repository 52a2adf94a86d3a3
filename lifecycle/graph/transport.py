"""Graph transports, layer 1 of the graph interface: sending to the graph and receiving from it.

Owns: the Protocol that every graph transport fulfils, and the one over DDS: one ROS topic with one
JSON message each, on a node that the caller has and spins, so that ordinary ROS tools can listen
(`ros2 topic echo /lifecycle/graph`). All participants of one graph must use the same one; a program
may bridge two by receiving from one and sending to the other. Owns also a steady timer for
heartbeats.
"""

from __future__ import annotations

import logging
import threading
import typing
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol

from rclpy.callback_groups import CallbackGroup, MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSDurabilityPolicy, QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy
from rclpy.subscription import Subscription
from std_msgs.msg import String

from lifecycle.errors import MiddlewareError
from lifecycle.verify.tool_filter import GRAPH_TOPIC

if TYPE_CHECKING:  # it imports asyncio, which a node that only reports has no use for
    from lifecycle.graph.scheduler import Remove


class GraphTransport(Protocol):
    """Carries messages to all in the graph.

    Nothing is promised about delivery: a message may be lost, doubled, late or out of order, and a
    sender may receive its own. `GraphEvents` on top copes with that.
    """

    def send(self, message: bytes) -> None:
        """Send one message to all who receive; any thread, never waits for a receiver.

        Raises:
            LifecycleError: it could not be handed over.
        """

    def receive(self, callback: Callable[[bytes], None]) -> Remove:
        """Have `callback` called with each message from now on, in a thread of the transport."""

    def on_peer(self, callback: Callable[[], None]) -> Remove:
        """Have `callback` called when a receiver is reached that was not before.

        The moment to say again who we are: after a late joiner came, or a partition healed.
        """

    def close(self) -> None:
        """Leave; again is harmless. Nothing is received after it."""


_logger = logging.getLogger(__name__)

GRAPH_QOS = QoSProfile(
    history=QoSHistoryPolicy.KEEP_LAST,
    depth=64,
    reliability=QoSReliabilityPolicy.RELIABLE,
    durability=QoSDurabilityPolicy.VOLATILE,
)
"""For a late joiner all is sent again (`on_peer`) rather than kept: what was is of no use."""


@typing.final
class DdsTransport:
    """Sends and receives on `/lifecycle/graph` with a node's own participant.

    The subscription is made by the first `receive` and the publisher by the first `send` or
    `on_peer`: a reporter has no subscription, and a reader no publisher.
    Callbacks run in the executor that spins the node. `close` it before the node is destroyed.

    Args:
        node: any rclpy node that is spun.
        qos: must fit that of all others; for participants that add liveliness to the same policies.
        callback_group: of the subscription and the events; by default one of its own.
    """

    def __init__(
        self,
        node: Node,
        *,
        qos: QoSProfile = GRAPH_QOS,
        callback_group: CallbackGroup | None = None,
    ) -> None:
        self._node = node
        self._qos = qos
        self._group = callback_group or MutuallyExclusiveCallbackGroup()
        self._lock = threading.Lock()
        self._callbacks: dict[object, Callable[[bytes], None]] = {}
        self._peer_callbacks: dict[object, Callable[[], None]] = {}
        self._readers = 0
        self._subscription: Subscription | None = None
        self._publisher: Publisher | None = None
        self._closed = False

    def send(self, message: bytes) -> None:
        """Publish one message; after `close` it goes nowhere.

        Raises:
            MiddlewareError: rcl does not take it, because the context was shut down, say.
        """
        try:
            publisher = self._made_publisher()
            if publisher is not None:
                publisher.publish(String(data=message.decode()))
        except Exception as error:
            raise MiddlewareError(f"cannot publish on {GRAPH_TOPIC}: {error}") from error

    def receive(self, callback: Callable[[bytes], None]) -> Remove:
        """Have `callback` called in the executor's thread with each message, our own included."""
        remove = self._keep(self._callbacks, callback)
        with self._lock:
            if self._subscription is None and not self._closed:
                self._subscription = Node.create_subscription(
                    self._node,
                    String,
                    GRAPH_TOPIC,
                    self._arrived,
                    self._qos,
                    callback_group=self._group,
                )
        return remove

    def on_peer(self, callback: Callable[[], None]) -> Remove:
        """Have `callback` called when a subscription of the topic was matched.

        Raises:
            MiddlewareError: the publisher could not be made.
        """
        remove = self._keep(self._peer_callbacks, callback)
        try:
            self._made_publisher()
        except Exception as error:
            raise MiddlewareError(f"cannot publish on {GRAPH_TOPIC}: {error}") from error
        return remove

    def close(self) -> None:
        """Destroy publisher and subscription; again is harmless."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            subscription, self._subscription = self._subscription, None
            publisher, self._publisher = self._publisher, None
        if publisher is not None:
            Node.destroy_publisher(self._node, publisher)
        if subscription is not None:
            Node.destroy_subscription(self._node, subscription)

    def _made_publisher(self) -> Publisher | None:
        """Return the publisher, made now if there was none; None after `close`."""
        with self._lock:
            if self._publisher is None and not self._closed:
                self._publisher = Node.create_publisher(
                    self._node,
                    String,
                    GRAPH_TOPIC,
                    self._qos,
                    callback_group=self._group,
                    event_callbacks=PublisherEventCallbacks(matched=self._matched),
                )
            return self._publisher

    def _arrived(self, message: String) -> None:
        data = message.data.encode()
        for callback in tuple(self._callbacks.values()):
            callback(data)

    def _matched(self, info: Any) -> None:
        # Several matches may come as one event; that a peer left does not matter here.
        before, self._readers = self._readers, info.current_count
        if info.current_count > before or info.current_count_change > 0:
            for callback in tuple(self._peer_callbacks.values()):
                callback()

    def _keep(self, callbacks: dict[object, Any], callback: Callable[..., None]) -> Remove:
        key = object()
        with self._lock:
            callbacks[key] = callback

        def remove() -> None:
            with self._lock:
                callbacks.pop(key, None)

        return remove


def steady_timer(node: Node) -> Callable[[float, Callable[[], None]], Remove]:
    """Return a periodic timer for `GraphReporter` in the executor of `node`.

    It runs on steady time: heartbeats must not stop with a simulation's clock.
    """
    clock = Clock(clock_type=ClockType.STEADY_TIME)

    def start(period_s: float, callback: Callable[[], None]) -> Remove:
        # rclpy's own factory: that of a LifecycleNode makes timers that run while it is active.
        timer = Node.create_timer(
            node, period_s, callback, callback_group=MutuallyExclusiveCallbackGroup(), clock=clock
        )

        def stop() -> None:
            Node.destroy_timer(node, timer)

        return stop

    return start
