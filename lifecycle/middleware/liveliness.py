"""Being heard, and noticing who is not heard any more.

Owns: the topics by which participants assert that they are there. DDS asserts the liveliness of an
AUTOMATIC writer from a thread of its own: it needs no Python, ends with SIGSTOP and SIGKILL, and
does not arrive over a link that is cut. The writer's lease says how often it is asserted, the
reader's how long it may stay unheard (DDS 1.4 §2.2.3.11), so many assertions may be lost between.

Fast DDS 2.14 does not repeat an assertion that was lost on the way (measured: with one each 0.2 s,
30 % loss and a lease of 0.9 s, five false alarms a minute), so it is asserted this often.
"""

from __future__ import annotations

import functools
import json
import logging
import typing
from collections.abc import Callable, Mapping

from rclpy.duration import Duration
from rclpy.event_handler import (
    PublisherEventCallbacks,
    QoSLivelinessChangedInfo,
    QoSPublisherMatchedInfo,
    SubscriptionEventCallbacks,
)
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Empty, String

from lifecycle.codec import from_json

UNHEARD_S = 0.85
"""Who was not heard for so long is lost: within a second with all that follows."""

ASSERTED_EACH_S = 0.06
"""Fourteen fit into UNHEARD_S. At 30 % loss all of them are lost once in thousands of runs of ten
minutes; one takes about 150 bytes to each participant that knows us."""

_LEASE_PER_PERIOD = 1.5
"""rmw_fastrtps asserts each two thirds of the lease that a writer offers."""


_LONGEST_NOTICE = 1 << 16
"""Characters of a notice; a line for each silent node."""

_logger = logging.getLogger(__name__)
_PULSE = "_pulse"
"""Ends the name of the topic that is asserted; the other one says what there is to say."""


def machine_topic(system: str, machine: str) -> str:
    """Return the hidden topic by which the supervisor of a machine is heard."""
    return f"/_lifecycle/{system.replace('-', '_')}/{machine}/alive"


def node_topic(full_name: str) -> str:
    """Return the hidden topic by which a node is heard that has no supervisor."""
    return f"{full_name}/_alive"


_TOLD = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
_no_publisher_events = functools.partial(PublisherEventCallbacks, use_default_callbacks=False)
_no_subscription_events = functools.partial(SubscriptionEventCallbacks, use_default_callbacks=False)


@typing.final
class AlivePublisher:
    """Makes the participant of `node` heard, for as long as it lives, by whoever listens.

    Nothing is asserted while nobody does: an assertion goes to every participant of the domain.

    Args:
        node: an executor spins it.
        topic: its own; nobody else publishes it.
        on_listener: called in the executor's thread when somebody begins to listen.
    """

    def __init__(
        self, node: Node, topic: str, on_listener: Callable[[], None] | None = None
    ) -> None:
        self._node = node
        self._topic = topic
        self._on_listener = on_listener
        self._pulse: Publisher | None = None
        # rclpy's own methods: a managed node's would gate them.
        self._publisher = Node.create_publisher(
            node,
            String,
            topic,
            _TOLD,
            event_callbacks=_no_publisher_events(matched=self._matched),
        )

    def tell(self, silent: Mapping[str, str]) -> None:
        """Say which of our nodes are silent, and why each is; from any thread.

        It is said to whoever listens now or later. A message may be lost for some seconds: say it
        again.
        """
        self._publisher.publish(String(data=json.dumps(dict(silent))))

    def destroy(self) -> None:
        """Leave, which is heard and is not a loss."""
        self._still()
        Node.destroy_publisher(self._node, self._publisher)

    def _matched(self, info: QoSPublisherMatchedInfo) -> None:
        if info.current_count == 0:
            self._still()
        elif self._pulse is None:
            self._pulse = Node.create_publisher(
                self._node,
                Empty,
                self._topic + _PULSE,
                _asserted(ASSERTED_EACH_S * _LEASE_PER_PERIOD),
                event_callbacks=_no_publisher_events(),
            )
        if info.current_count_change > 0 and self._on_listener is not None:
            self._on_listener()

    def _still(self) -> None:
        if self._pulse is not None:
            Node.destroy_publisher(self._node, self._pulse)
            self._pulse = None


@typing.final
class AliveSubscription:
    """Hears one AlivePublisher.

    Args:
        node: an executor spins it; callbacks come in that executor's thread.
        topic: of the publisher.
        on_heard: told True when it is heard, False when it is not any more.
        on_left: told that it left properly.
        on_told: told what `AlivePublisher.tell` said.
    """

    def __init__(
        self,
        node: Node,
        topic: str,
        *,
        on_heard: Callable[[bool], None],
        on_left: Callable[[], None],
        on_told: Callable[[Mapping[str, str]], None],
    ) -> None:
        def changed(info: QoSLivelinessChangedInfo) -> None:
            if info.alive_count > 0:
                on_heard(True)
            elif info.not_alive_count > 0:
                on_heard(False)
            else:
                on_left()

        def told(message: String) -> None:
            try:
                on_told(from_json(message.data, dict[str, str], longest=_LONGEST_NOTICE))
            except ValueError as error:
                # Anybody may write the topic, and no executor thread may end by it.
                _logger.warning("cannot read what is silent: %s", error)

        self._node = node
        self._subscriptions = (
            node.create_subscription(
                Empty,
                topic + _PULSE,
                _ignore,
                _asserted(UNHEARD_S),
                event_callbacks=_no_subscription_events(liveliness=changed),
            ),
            node.create_subscription(
                String, topic, told, _TOLD, event_callbacks=_no_subscription_events()
            ),
        )

    def destroy(self) -> None:
        """Hear no more."""
        for each in self._subscriptions:
            self._node.destroy_subscription(each)


def _asserted(lease_s: float) -> QoSProfile:
    return QoSProfile(
        depth=1,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.VOLATILE,
        liveliness=LivelinessPolicy.AUTOMATIC,
        liveliness_lease_duration=Duration(nanoseconds=round(lease_s * 1e9)),
    )


def _ignore(message: Empty) -> None:
    """Nothing is ever published: the writer's liveliness is the message."""
