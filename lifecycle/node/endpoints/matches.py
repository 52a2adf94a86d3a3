"""Told when the peers of a topic endpoint change. Owns: rclpy's matched events on our executor.

The event is handled in a group of the framework's: an author's callback that awaits something must
not hold back the news that a peer has come or gone.
"""

from __future__ import annotations

import typing
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rclpy.event_handler import (
    EventHandler,
    QoSPublisherEventType,
    QoSSubscriptionEventType,
    UnsupportedEventTypeError,
)
from rclpy.publisher import Publisher

if TYPE_CHECKING:
    from rclpy.callback_groups import CallbackGroup
    from rclpy.node import Node
    from rclpy.subscription import Subscription


def count_peers(entity: Publisher | Subscription) -> int:
    """Return how many remote endpoints are matched with a publisher or subscription."""
    if isinstance(entity, Publisher):
        return int(entity.get_subscription_count())
    return int(entity.get_publisher_count())


@typing.final
class MatchWatch:
    """Calls back with the number of matched peers each time it has changed.

    Args:
        node: whose executor calls; the endpoint may stand on another participant.
        entity: what to watch.
        group: reentrant.
        changed: takes the number of matched peers, >= 0.
    """

    def __init__(
        self,
        node: Node,
        entity: Publisher | Subscription,
        group: CallbackGroup,
        changed: Callable[[int], None],
    ) -> None:
        self._node = node
        self._handler: EventHandler | None = None
        publishes = isinstance(entity, Publisher)
        event = (
            QoSPublisherEventType.RCL_PUBLISHER_MATCHED
            if publishes
            else QoSSubscriptionEventType.RCL_SUBSCRIPTION_MATCHED
        )

        def matched(status: Any) -> None:
            changed(int(status.current_count))

        try:
            self._handler = EventHandler(
                callback_group=group, callback=matched, event_type=event, parent_impl=entity.handle
            )
        except UnsupportedEventTypeError:
            return  # an RMW without the event: counts are then read when somebody asks
        node.add_waitable(self._handler)

    def stop(self) -> None:
        """End it, before the endpoint is destroyed; again is harmless."""
        if self._handler is not None:
            self._node.remove_waitable(self._handler)
            self._handler.destroy()
            self._handler = None
