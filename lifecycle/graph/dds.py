"""The graph transport over DDS: one ROS topic, one JSON message each.

Owns: the topic's name, type and QoS, and a steady timer for heartbeats. Everything happens on a
node that the caller has and spins; ordinary ROS tools can listen (`ros2 topic echo
/lifecycle/graph`).
"""

from __future__ import annotations

import logging
import threading
import typing
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rclpy.callback_groups import CallbackGroup, MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSDurabilityPolicy, QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy
from rclpy.subscription import Subscription
from std_msgs.msg import String

from lifecycle.errors import MiddlewareError
from lifecycle.verify import GRAPH_TOPIC

if TYPE_CHECKING:  # it imports asyncio, which a node that only reports has no use for
    from lifecycle.graph.scheduler import Remove

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
                self._subscription = self._node.create_subscription(
                    String, GRAPH_TOPIC, self._arrived, self._qos, callback_group=self._group
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
            self._node.destroy_publisher(publisher)
        if subscription is not None:
            self._node.destroy_subscription(subscription)

    def _made_publisher(self) -> Publisher | None:
        """Return the publisher, made now if there was none; None after `close`."""
        with self._lock:
            if self._publisher is None and not self._closed:
                self._publisher = self._node.create_publisher(
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
    """Return a timer (`lifecycle.graph.Every`) in the executor of `node`.

    It runs on steady time: heartbeats must not stop with a simulation's clock.
    """
    clock = Clock(clock_type=ClockType.STEADY_TIME)

    def start(period_s: float, callback: Callable[[], None]) -> Remove:
        timer = node.create_timer(
            period_s, callback, callback_group=MutuallyExclusiveCallbackGroup(), clock=clock
        )

        def stop() -> None:
            node.destroy_timer(timer)

        return stop

    return start
