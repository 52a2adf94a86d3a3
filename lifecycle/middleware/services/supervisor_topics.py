"""What supervisors publish and offer in ROS: that they live, their plans, their status.

Owns: the topics by which participants assert their liveliness (MANUAL_BY_TOPIC); that of plans, by
which supervisors of one domain detect conflicts; /diagnostics, the latched status and the Trigger
services of a supervisor. Plans, statuses and answers are text and numbers here.

A thread of ours asserts liveliness: it ends with SIGSTOP and SIGKILL, and does not arrive over a
link that is cut. A callback that holds the interpreter's lock for longer than the lease expires it
too. Fast DDS's event thread, which would assert an AUTOMATIC writer, does nothing while a leaving
peer is removed. Fast DDS 2.14 does not repeat an assertion that was lost, so it is asserted this
often.

Beside which nodes are silent, a notice says when its sender received the last one of each other
supervisor. So two of them exchange the four timestamps by which their clocks are compared
(lifecycle.measure.clock): Fast DDS takes them where it sends and receives. It says on which ports
its sender receives marked datagrams, too (lifecycle.supervisor.nodes.marks).
"""

from __future__ import annotations

import contextlib
import functools
import logging
import threading
import time
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import msgspec
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.duration import Duration
from rclpy.event_handler import (
    PublisherEventCallbacks,
    QoSLivelinessChangedInfo,
    QoSPublisherMatchedInfo,
    SubscriptionEventCallbacks,
)
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rclpy.qos import LivelinessPolicy, QoSProfile
from rclpy.task import Future
from std_msgs.msg import String

from lifecycle.codec import from_json, to_json
from lifecycle.manifest.names import DIAGNOSTICS_TOPIC, supervisor_status_topic
from lifecycle.middleware.rcl import abi
from lifecycle.middleware.rcl.conversions import latched

if TYPE_CHECKING:  # few processes need them
    from std_srvs.srv import Trigger

_LEASE_S = 0.85
"""A participant whose liveliness was not asserted for so long is lost: within a second with all
that follows."""

_ASSERTED_EACH_S = 0.06
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


_ALIVE = latched(1)
_ALIVE.liveliness = LivelinessPolicy.MANUAL_BY_TOPIC
_ALIVE.liveliness_lease_duration = Duration(nanoseconds=round(_LEASE_S * 1e9))
_no_subscription_events = functools.partial(SubscriptionEventCallbacks, use_default_callbacks=False)


def _publisher(node: Node, type_: type[Any], topic: str, qos: QoSProfile, **events: Any) -> Any:
    """Make a publisher by rclpy's own method: a managed node's would gate it."""
    callbacks = PublisherEventCallbacks(use_default_callbacks=False, **events)
    return Node.create_publisher(node, type_, topic, qos, event_callbacks=callbacks)


@typing.final
class AlivePublisher:
    """Asserts the liveliness of the participant of `node` to its subscribers while it lives.

    The thread that asserts is there from the start: there may be no room for another one later.

    Args:
        node: an executor spins it.
        topic: its own; published by nothing else.
        on_listener: called in the executor's thread when a subscriber is matched.
    """

    def __init__(self, node: Node, topic: str, on_listener: Callable[[], None]) -> None:
        self._node = node
        self._on_listener = on_listener
        self._ended = threading.Event()
        self._publisher = _publisher(node, String, topic, _ALIVE, matched=self._matched)
        self._thread = threading.Thread(target=self._assert, name="pulse", daemon=True)
        self._thread.start()

    def notify(self, notice: AliveNotice) -> None:
        """Publish which of our nodes are silent, and what else there is to say; from any thread.

        A message may be lost for some seconds: publish it again.
        """
        self._publisher.publish(String(data=to_json(notice).decode()))

    def destroy(self) -> None:
        """Leave properly, which peers see and do not count as a loss."""
        self._ended.set()
        self._thread.join()
        Node.destroy_publisher(self._node, self._publisher)

    def _matched(self, info: QoSPublisherMatchedInfo) -> None:
        if info.current_count_change > 0:
            self._on_listener()

    def _assert(self) -> None:
        # Not by rclpy's own call, which keeps the GIL: Fast DDS takes locks there, and was seen not
        # to give them back while peers left.
        with contextlib.suppress(InvalidHandle):  # its node was destroyed first
            while not self._ended.wait(_ASSERTED_EACH_S):
                with self._publisher.handle:
                    abi.assert_liveliness(self._publisher.handle.pointer)


@typing.final
class AliveSubscription:
    """Follows one AlivePublisher; callbacks run in the executor that spins `node`.

    Args:
        node: an executor spins it.
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
        events = _no_subscription_events(liveliness=changed)
        self._subscription = node.create_subscription(
            String, topic, received, _ALIVE, event_callbacks=events
        )

    def destroy(self) -> None:
        """Destroy the subscription."""
        self._node.destroy_subscription(self._subscription)


PLANS_TOPIC = "/_lifecycle/plans"

_KEPT = 64
"""Notices that come in one burst, of as many supervisors."""


@typing.final
class PlanNotices:
    """Announces our plan and receives those of others, ours too; `destroy` it.

    The topic's name holds no system: a supervisor that was started with another manifest must be
    noticed too. Callbacks run in the executor that spins `node`.
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
        self._publisher = _publisher(node, String, PLANS_TOPIC, latched(1), matched=self._matched)

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


_DIAGNOSTICS = QoSProfile(depth=10)
"""Reliable and volatile, as rclpy has it by default."""

_LAST = Duration(nanoseconds=200_000_000)
"""Within so long who is there has acknowledged what was published last: a round trip or two."""

Entry = tuple[int, str, str, str, Sequence[tuple[str, str]]]
"""Level, name, message, hardware id and values of a diagnostic_msgs/DiagnosticStatus."""


@typing.final
class RosInterface:
    """The topics and services of one supervisor; `destroy` it before its node.

    Args:
        node: an executor spins it.
        prefix: under which the status topic and the services are, `/lifecycle/patrol`.
        services: names of the services.
        on_call: called in the executor's thread with the name of a service that is called and with
            what answers the call (success, message), which may be called once from any thread.
        diagnoses: publish on /diagnostics, too.
    """

    def __init__(
        self,
        node: Node,
        prefix: str,
        services: Iterable[str],
        on_call: Callable[[str, Callable[[bool, str], None]], None],
        *,
        diagnoses: bool = True,
    ) -> None:
        from diagnostic_msgs.msg import DiagnosticArray
        from std_srvs.srv import Trigger

        self._node = node
        self._on_call = on_call
        # Others are served while one call waits for its answer.
        group = ReentrantCallbackGroup()
        self._status = _publisher(node, String, supervisor_status_topic(prefix), latched(1))
        self._diagnostics = None
        if diagnoses:
            self._diagnostics = _publisher(node, DiagnosticArray, DIAGNOSTICS_TOPIC, _DIAGNOSTICS)
        self._services = tuple(
            Node.create_service(
                node, Trigger, f"{prefix}/{name}", self._served(name), callback_group=group
            )
            for name in services
        )
        if node.executor is not None:
            node.executor.wake()

    def publish_status(self, text: str) -> None:
        """Publish the status to present and later subscribers."""
        self._status.publish(String(data=text))

    def publish_diagnostics(self, entries: Iterable[Entry]) -> None:
        """Publish diagnostics, if anything subscribes to them."""
        if self._diagnostics is None or not self._diagnostics.get_subscription_count():
            return
        from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

        message = DiagnosticArray()
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.status = [
            DiagnosticStatus(
                level=bytes([level]),
                name=name,
                message=text,
                hardware_id=hardware_id,
                values=[KeyValue(key=key, value=value) for key, value in values],
            )
            for level, name, text, hardware_id, values in entries
        ]
        self._diagnostics.publish(message)

    def destroy(self) -> None:
        """Offer and publish nothing any more; what was published last has arrived, if it can."""
        for service in self._services:
            Node.destroy_service(self._node, service)
        for publisher in (self._status, self._diagnostics):
            if publisher is None:
                continue
            if publisher.get_subscription_count():
                publisher.wait_for_all_acked(_LAST)
            Node.destroy_publisher(self._node, publisher)

    def _served(self, name: str) -> Callable[[Any, Any], Any]:
        async def serve(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            del request
            answered: Future = Future()

            def answer(success: bool, message: str) -> None:
                response.success, response.message = success, message
                answered.set_result(None)
                with contextlib.suppress(InvalidHandle):
                    if self._node.executor is not None:
                        self._node.executor.wake()

            self._on_call(name, answer)
            await answered
            return response

        return serve
