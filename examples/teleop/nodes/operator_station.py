"""The operator station: subscriptions S1 and S2 of the article's example, and the driver."""

from __future__ import annotations

import json
import time

from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rclpy.lifecycle import LifecycleState
from rclpy.time import Time
from sensor_msgs.msg import BatteryState, CompressedImage
from std_srvs.srv import SetBool, Trigger

from examples.teleop.models import scene
from examples.teleop.models.motion import Pose
from examples.teleop.models.steering import Tour
from examples.teleop.models.topic_health import Health, TopicMeter
from examples.teleop.nodes import messages
from lifecycle import LifecycleNode, on_message, on_service, on_timer


class OperatorStation(LifecycleNode):
    """Watches the video, drives the robot round the room, and says once a second how it goes."""

    def on_configure(self, _state: LifecycleState) -> None:
        """Plan the tour and set the timer that drives."""
        self._tour = Tour(cruise_mps=self.get_parameter("cruise_mps").value)
        self._pose: Pose | None = None
        self._video = TopicMeter("video", 1.0)
        self._size_px = (0, 0)
        self._frame_bytes = 0
        self._delay_ms = 0.0
        self._charge = 0.0
        self._warnings = ""
        self._timer = self.create_timer(1 / self.get_parameter("rate_hz").value, self._drive)

    def on_cleanup(self, _state: LifecycleState) -> None:
        """Take back the timer, or configuring again would start a second one."""
        self.destroy_timer(self._timer)

    @on_timer(period_s=1.0)
    def _say(self) -> None:
        self.get_logger().info(self._summary())

    @on_message("video")
    def _show(self, message: CompressedImage) -> None:
        data = bytes(message.data)
        try:
            self._size_px = scene.decode(data).size
        except ValueError as error:
            self.get_logger().warning(str(error))
            return
        self._frame_bytes = len(data)
        age = self.get_clock().now() - Time.from_msg(message.header.stamp)
        self._delay_ms = age.nanoseconds / 1e6
        self._video.arrived(time.monotonic())

    @on_message("battery")
    def _charge_left(self, message: BatteryState) -> None:
        self._charge = message.percentage

    @on_message("odometry")
    def _robot_moved(self, message: Odometry) -> None:
        self._pose = messages.pose_of(message)

    @on_message("/diagnostics")
    def _diagnosed(self, message: DiagnosticArray) -> None:
        sick = (f"{each.name}: {each.message}" for each in message.status if each.level != b"\0")
        warnings = "; ".join(sick)
        if warnings and warnings != self._warnings:
            self.get_logger().warning(warnings)
        self._warnings = warnings

    @on_service("~/status")
    def _status(
        self,
        request: Trigger.Request,  # noqa: ARG002
        response: Trigger.Response,
    ) -> Trigger.Response:
        """Answer with what the station sees, as JSON; a failure while the video is not healthy."""
        video = self._video.judged(time.monotonic())
        response.success = video.health is Health.OK
        response.message = json.dumps(
            {
                "frames": self._video.count,
                "video_hz": round(video.rate_hz, 2),
                "frame_px": self._size_px,
                "frame_bytes": self._frame_bytes,
                "delay_ms": round(self._delay_ms, 2),
                "charge": round(self._charge, 4),
                "x_m": round(self._pose.x_m, 3) if self._pose else None,
                "y_m": round(self._pose.y_m, 3) if self._pose else None,
            }
        )
        return response

    @on_service("~/stop")
    async def _stop(
        self,
        request: SetBool.Request,
        response: SetBool.Response,  # noqa: ARG002
    ) -> SetBool.Response:
        """Pass the emergency stop on to the base and answer with the base's own answer."""
        answer: SetBool.Response = await self.client("emergency_stop").call_async(request)
        return answer

    def _drive(self) -> None:
        if self._pose is None:
            return  # without odometry, silence: the base stops by itself
        self._tour = self._tour.advanced(self._pose)
        self.publisher("cmd_vel").publish(messages.twist(self._tour.command(self._pose)))

    def _summary(self) -> str:
        if self._pose is None or self._video.count == 0:
            return "waiting for the robot"
        video = self._video.judged(time.monotonic())
        width, height = self._size_px
        return (
            f"video {width}x{height} {video.message} {self._frame_bytes / 1000:.1f} kB "
            f"{self._delay_ms:.1f} ms old | battery {self._charge:.1%} | "
            f"robot at {self._pose.x_m:+.2f} {self._pose.y_m:+.2f} m"
        )
