"""The health monitor: subscribes to everything and publishes rates and stale topics."""

from __future__ import annotations

import time

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from rclpy.lifecycle import LifecycleState
from sensor_msgs.msg import BatteryState, CompressedImage, LaserScan

from examples.teleop.models.topic_health import TopicHealth, TopicMeter
from lifecycle import LifecycleNode, on_message

_TOPICS = ("video", "battery", "scan", "odometry", "cmd_vel")


class HealthMonitor(LifecycleNode):
    """Compares each topic's rate with the least rate that its parameter `<topic>_hz` says."""

    def on_configure(self, _state: LifecycleState) -> None:
        """Make one meter per topic and set the report timer."""
        self._meters = {
            topic: TopicMeter(topic, self.get_parameter(f"{topic}_hz").value) for topic in _TOPICS
        }
        self._timer = self.create_timer(1 / self.get_parameter("rate_hz").value, self._report)

    def on_cleanup(self, _state: LifecycleState) -> None:
        """Take back the timer, or configuring again would start a second one."""
        self.destroy_timer(self._timer)

    def on_activate(self, _state: LifecycleState) -> None:
        """Forget what was measured before; nothing could arrive while inactive."""
        for meter in self._meters.values():
            meter.forget()

    @on_message("video")
    def _video(self, message: CompressedImage) -> None:  # noqa: ARG002
        self._arrived("video")

    @on_message("battery")
    def _battery(self, message: BatteryState) -> None:  # noqa: ARG002
        self._arrived("battery")

    @on_message("scan")
    def _scan(self, message: LaserScan) -> None:  # noqa: ARG002
        self._arrived("scan")

    @on_message("odometry")
    def _odometry(self, message: Odometry) -> None:  # noqa: ARG002
        self._arrived("odometry")

    @on_message("cmd_vel")
    def _cmd_vel(self, message: Twist) -> None:  # noqa: ARG002
        self._arrived("cmd_vel")

    def _arrived(self, topic: str) -> None:
        self._meters[topic].arrived(time.monotonic())

    def _report(self) -> None:
        now_s = time.monotonic()
        message = DiagnosticArray()
        message.header.stamp = self.get_clock().now().to_msg()
        message.status = [_status(meter.judged(now_s)) for meter in self._meters.values()]
        self.publisher("/diagnostics").publish(message)


def _status(topic: TopicHealth) -> DiagnosticStatus:
    return DiagnosticStatus(
        level=bytes([topic.health]),
        name=f"topic {topic.topic}",
        message=topic.message,
        hardware_id="robot",
        values=[
            KeyValue(key="rate_hz", value=f"{topic.rate_hz:.2f}"),
            KeyValue(key="age_s", value="never" if topic.age_s is None else f"{topic.age_s:.3f}"),
        ],
    )
