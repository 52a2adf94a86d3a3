"""The topic on which supervisors of one domain publish their plans, to detect conflicts.

Owns: `PlanNotices`. The name of the topic holds no system: a supervisor that was started with
another manifest must be noticed too. The last notice of each is kept for late joiners. Its content
is text here, see lifecycle.plan.comparison.
"""

from __future__ import annotations

import typing
from collections.abc import Callable

from rclpy.event_handler import (
    PublisherEventCallbacks,
    QoSPublisherMatchedInfo,
    SubscriptionEventCallbacks,
)
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String

TOPIC = "/_lifecycle/plans"

_KEPT = 64
"""Notices that come in one burst, of as many supervisors."""


@typing.final
class PlanNotices:
    """Announces our plan and receives those of others; `destroy` it.

    Args:
        node: an executor spins it; callbacks run in that executor's thread.
        on_notice: called with each text that arrives, our own too.
    """

    def __init__(self, node: Node, on_notice: Callable[[str], None]) -> None:
        self._node = node
        self._text = ""
        self._subscription = node.create_subscription(
            String,
            TOPIC,
            lambda message: on_notice(message.data),
            _qos(_KEPT),
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
        )
        # rclpy's own methods: a managed node's would gate them.
        self._publisher = Node.create_publisher(
            node,
            String,
            TOPIC,
            _qos(1),
            event_callbacks=PublisherEventCallbacks(
                matched=self._matched, use_default_callbacks=False
            ),
        )

    def announce(self, text: str) -> None:
        """Publish `text` to present and later subscribers; from any thread."""
        self._text = text
        self._publisher.publish(String(data=text))

    def destroy(self) -> None:
        """Announce and receive nothing any more."""
        self._node.destroy_subscription(self._subscription)
        Node.destroy_publisher(self._node, self._publisher)

    def _matched(self, info: QoSPublisherMatchedInfo) -> None:
        """Announce again: Fast DDS repeats what a newcomer lost after up to 3 s."""
        if info.current_count_change > 0 and self._text:
            self._publisher.publish(String(data=self._text))


def _qos(depth: int) -> QoSProfile:
    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
    )
