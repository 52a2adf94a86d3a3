"""The base: velocity commands in, odometry out; stops when commands go stale or a wall is near."""

from __future__ import annotations

import math
import time

from geometry_msgs.msg import Twist
from rclpy.lifecycle import LifecycleState
from sensor_msgs.msg import LaserScan
from std_srvs.srv import SetBool

from examples.teleop.models.motion import (
    STANDSTILL,
    CommandWatch,
    DriveLimits,
    Pose,
    accelerated,
    guarded,
    moved,
)
from examples.teleop.models.room import clearance
from examples.teleop.nodes import messages
from lifecycle import LifecycleNode, on_message, on_service


class Base(LifecycleNode):
    """Integrates what the motors do and publishes where that leads."""

    def on_configure(self, _state: LifecycleState) -> None:
        """Stand at the start and set the drive timer."""
        self._limits = DriveLimits()
        self._pose = Pose(
            x_m=self.get_parameter("start_x_m").value, y_m=self.get_parameter("start_y_m").value
        )
        self._velocity = STANDSTILL
        self._commands = CommandWatch(self.get_parameter("command_timeout_s").value)
        self._clearance_m = math.inf
        self._stopped = False
        self._timer = self.create_timer(1 / self.get_parameter("rate_hz").value, self._drive)

    def on_cleanup(self, _state: LifecycleState) -> None:
        """Take back the timer, or configuring again would start a second one."""
        self.destroy_timer(self._timer)

    def on_activate(self, _state: LifecycleState) -> None:
        """Begin at standstill; the time spent inactive was not spent driving."""
        self._velocity = STANDSTILL
        self._commands.clear()
        self._driven_until_s = time.monotonic()

    @on_message("cmd_vel")
    def _command(self, message: Twist) -> None:
        self._commands.command(messages.velocity_of(message), time.monotonic())

    @on_message("scan")
    def _look_ahead(self, message: LaserScan) -> None:
        self._clearance_m = clearance(
            message.ranges, message.angle_min, message.angle_increment, math.radians(25)
        )

    @on_service("~/emergency_stop")
    def _emergency_stop(
        self, request: SetBool.Request, response: SetBool.Response
    ) -> SetBool.Response:
        """Stop at once and stay so (`data: true`), or obey commands again (`data: false`)."""
        self._stopped = request.data
        response.success = True
        response.message = "stopped" if self._stopped else "released"
        self.get_logger().warning(f"emergency stop: {response.message}")
        return response

    def _drive(self) -> None:
        now_s = time.monotonic()
        duration_s = now_s - self._driven_until_s
        self._driven_until_s = now_s
        if self._stopped:
            self._velocity = STANDSTILL
        else:
            wanted = guarded(self._commands.wanted(now_s), self._clearance_m, 0.35)
            self._velocity = accelerated(self._velocity, wanted, self._limits, duration_s)
        self._pose = moved(self._pose, self._velocity, duration_s)
        message = messages.odometry(self._pose, self._velocity)
        message.header.stamp = self.get_clock().now().to_msg()
        self.publisher("odometry").publish(message)
