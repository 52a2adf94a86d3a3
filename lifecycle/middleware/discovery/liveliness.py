"""Liveliness (MANUAL_BY_TOPIC) of processes and its lease, and the plans that supervisors publish.

Owns: the topics by which participants assert their liveliness. A thread of ours asserts that of a
MANUAL_BY_TOPIC writer: it ends with SIGSTOP and SIGKILL, and does not arrive over a link that is
cut. A callback that holds the interpreter's lock for longer than the lease expires it too.

Fast DDS 2.14 does not repeat an assertion that was lost, so it is asserted this often. Its event
thread, which would assert an AUTOMATIC writer, stands still while a leaving peer is removed.

Beside which nodes are silent, a notice says when its sender received the last one of each other
supervisor. So two of them exchange the four timestamps by which their clocks are compared
(lifecycle.measure.clock): Fast DDS takes them where it sends and receives. It says on which ports
its sender receives marked datagrams, too (lifecycle.supervisor.nodes.marks).

`PlanNotices` is the topic on which supervisors of one domain publish their plans, to detect
conflicts. Its name holds no system: a supervisor that was started with another manifest must be
noticed too. The last notice of each is kept for late joiners. Its content is text here, see
lifecycle.plan.comparison.
"""

from __future__ import annotations

import functools
import logging
import threading
import time
import typing
from collections.abc import Callable, Mapping

import msgspec
from rclpy.duration import Duration
from rclpy.event_handler import (
    PublisherEventCallbacks,
    QoSLivelinessChangedInfo,
    QoSPublisherMatchedInfo,
    SubscriptionEventCallbacks,
)
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Empty, String

from lifecycle.codec import from_json, to_json
from lifecycle.manifest.names import ALIVE_PULSE
from lifecycle.middleware.rcl import abi
from lifecycle.middleware.rcl.qos import latched

ALIVE_LEASE_S = 0.85
"""A participant whose liveliness was not asserted for so long is lost: within a second with all
that follows."""

ASSERTED_EACH_S = 0.06
"""Fourteen fit into the lease; one takes about 150 bytes to each participant that discovered us."""

_LONGEST_NOTICE = 1 << 16
"""Characters of a notice; a line for each silent node."""

_Number = typing.Annotated[int, msgspec.Meta(ge=0, lt=1 << 62)]

_Port = typing.Annotated[int, msgspec.Meta(ge=0, le=65535)]


class AliveNotice(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What a participant says beside that it is alive.

    Attributes:
        silent: which of its nodes are silent, and why each is.
        received: when the last notice of each other machine was sent, on that one's clock, and
            received, on the sender's, ns; and its `asks`.
        asks: how often the sender has asked what time it is: others answer each question at once.
        marks: ports on which it receives marked datagrams, over IPv4 and IPv6; 0 for none.
    """

    silent: Mapping[str, str]
    received: Mapping[str, tuple[_Number, _Number, _Number]] = {}
    asks: _Number = 0
    marks: tuple[_Port, _Port] = (0, 0)


_logger = logging.getLogger(__name__)


_NOTICES = latched(1)
_ASSERTED = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE,
    liveliness=LivelinessPolicy.MANUAL_BY_TOPIC,
    liveliness_lease_duration=Duration(nanoseconds=round(ALIVE_LEASE_S * 1e9)),
)
_no_publisher_events = functools.partial(PublisherEventCallbacks, use_default_callbacks=False)
_no_subscription_events = functools.partial(SubscriptionEventCallbacks, use_default_callbacks=False)


@typing.final
class AlivePublisher:
    """Asserts the liveliness of the participant of `node` to its subscribers while it lives.

    Nothing is asserted while there is no subscriber. The thread that asserts is there from the
    start: there may be no room for another one later.

    Args:
        node: an executor spins it.
        topic: its own; published by nothing else.
        on_listener: called in the executor's thread when a subscriber is matched.
    """

    def __init__(
        self, node: Node, topic: str, on_listener: Callable[[], None] | None = None
    ) -> None:
        self._node = node
        self._on_listener = on_listener
        self._has_listeners = threading.Event()
        self._ended = threading.Event()
        # rclpy's own methods: a managed node's would gate them.
        make = functools.partial(Node.create_publisher, node)
        self._asserted = make(
            Empty, topic + ALIVE_PULSE, _ASSERTED, event_callbacks=_no_publisher_events()
        )
        self._publisher = make(
            String, topic, _NOTICES, event_callbacks=_no_publisher_events(matched=self._matched)
        )
        self._thread = threading.Thread(target=self._assert, name="pulse", daemon=True)
        self._thread.start()

    def notify(self, notice: AliveNotice) -> None:
        """Publish which of our nodes are silent, and what else there is to say; from any thread.

        Present and later subscribers receive it. A message may be lost for some seconds: publish
        it again.
        """
        self._publisher.publish(String(data=to_json(notice).decode()))

    def destroy(self) -> None:
        """Leave properly, which peers see and do not count as a loss."""
        self._ended.set()
        self._has_listeners.set()
        self._thread.join()
        for each in (self._asserted, self._publisher):
            Node.destroy_publisher(self._node, each)

    def _matched(self, info: QoSPublisherMatchedInfo) -> None:
        if info.current_count:
            self._has_listeners.set()
        else:
            self._has_listeners.clear()
            if self._ended.is_set():
                self._has_listeners.set()
        if info.current_count_change > 0 and self._on_listener is not None:
            self._on_listener()

    def _assert(self) -> None:
        while self._has_listeners.wait() and not self._ended.is_set():
            # Not by rclpy's own call, which keeps the GIL: Fast DDS takes locks there, and was seen
            # not to give them back while peers left.
            try:
                with self._asserted.handle:
                    abi.assert_liveliness(self._asserted.handle.pointer)
            except InvalidHandle:
                return  # its node was destroyed first
            self._ended.wait(ASSERTED_EACH_S)


@typing.final
class AliveSubscription:
    """Follows one AlivePublisher.

    Args:
        node: an executor spins it; callbacks run in that executor's thread.
        topic: of the publisher.
        on_liveliness: called with True when it is alive, False when its lease has expired.
        on_left: called when it left properly.
        on_notice: called with what `AlivePublisher.notify` published, when that was sent, on its
            clock, and when it was received, on ours, in nanoseconds.
    """

    def __init__(
        self,
        node: Node,
        topic: str,
        *,
        on_liveliness: Callable[[bool], None],
        on_left: Callable[[], None],
        on_notice: Callable[[AliveNotice, int, int], None],
    ) -> None:
        def changed(info: QoSLivelinessChangedInfo) -> None:
            if info.alive_count > 0:
                on_liveliness(True)
            elif info.not_alive_count > 0:
                on_liveliness(False)
            else:
                on_left()

        def received(message: String, info: Mapping[str, int]) -> None:
            try:
                notice = from_json(message.data, AliveNotice, longest=_LONGEST_NOTICE)
            except ValueError as error:
                # Any participant may write the topic, and no executor thread may end by it.
                _logger.warning("cannot read what is silent: %s", error)
                return
            received_ns = info["received_timestamp"] or time.time_ns()
            on_notice(notice, info["source_timestamp"], received_ns)

        self._node = node
        self._subscriptions = (
            node.create_subscription(
                Empty,
                topic + ALIVE_PULSE,
                lambda _: None,  # nothing is published: the writer's liveliness is the message
                _ASSERTED,
                event_callbacks=_no_subscription_events(liveliness=changed),
            ),
            node.create_subscription(
                String, topic, received, _NOTICES, event_callbacks=_no_subscription_events()
            ),
        )

    def destroy(self) -> None:
        """Destroy the subscriptions."""
        for each in self._subscriptions:
            self._node.destroy_subscription(each)


PLANS_TOPIC = "/_lifecycle/plans"

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
            PLANS_TOPIC,
            lambda message: on_notice(message.data),
            latched(_KEPT),
            event_callbacks=_no_subscription_events(),
        )
        # rclpy's own methods: a managed node's would gate them.
        self._publisher = Node.create_publisher(
            node,
            String,
            PLANS_TOPIC,
            _NOTICES,
            event_callbacks=_no_publisher_events(matched=self._matched),
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
