"""The lidar: scans of the simulated room from where odometry says the robot stands."""

from __future__ import annotations

import array
import math

from nav_msgs.msg import Odometry
from rclpy.lifecycle import LifecycleState
from sensor_msgs.msg import LaserScan

from examples.teleop.models.motion import Pose
from examples.teleop.models.room import ROOM
from examples.teleop.nodes.messages import pose_of
from lifecycle import LifecycleNode, on_message


class Lidar(LifecycleNode):
    """Scans all round; silent until the first odometry, for it would have to invent where it is."""

    def on_configure(self, _state: LifecycleState) -> None:
        """Take the number of beams and set the scan timer."""
        self._pose: Pose | None = None
        self._beams = self.get_parameter("beams").value
        self._rate_hz = self.get_parameter("rate_hz").value
        self._timer = self.create_timer(1 / self._rate_hz, self._scan)

    def on_cleanup(self, _state: LifecycleState) -> None:
        """Take back the timer, or configuring again would start a second one."""
        self.destroy_timer(self._timer)

    @on_message("odometry")
    def _move(self, message: Odometry) -> None:
        self._pose = pose_of(message)

    def _scan(self) -> None:
        if self._pose is None:
            return
        step_rad = math.tau / self._beams
        message = LaserScan(
            angle_min=-math.pi,
            angle_max=math.pi - step_rad,
            angle_increment=step_rad,
            scan_time=1 / self._rate_hz,
            range_min=0.05,
            range_max=12.0,
            ranges=array.array("f", ROOM.scan(self._pose, self._beams)),
        )
        message.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id = "lidar"
        self.publisher("scan").publish(message)
