"""What a supervisor offers in ROS: /diagnostics, a latched status topic, Trigger services.

Owns: the entities and their QoS. What is published is text and numbers here, see
lifecycle.supervisor.control.ros_interface, which also answers what is asked.
"""

from __future__ import annotations

import contextlib
import typing
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.task import Future
from std_msgs.msg import String
from std_srvs.srv import Trigger

from lifecycle.manifest.names import DIAGNOSTICS_TOPIC, supervisor_status_topic
from lifecycle.middleware.rcl.qos import latched

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
        self._node = node
        self._on_call = on_call
        # Others are served while one call waits for its answer.
        group = ReentrantCallbackGroup()
        quiet = PublisherEventCallbacks(use_default_callbacks=False)
        # rclpy's own methods, as everywhere on an observer's node.
        self._status = Node.create_publisher(
            node, String, supervisor_status_topic(prefix), latched(1), event_callbacks=quiet
        )
        self._diagnostics = (
            Node.create_publisher(
                node, DiagnosticArray, DIAGNOSTICS_TOPIC, _DIAGNOSTICS, event_callbacks=quiet
            )
            if diagnoses
            else None
        )
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
