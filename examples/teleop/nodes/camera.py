"""The camera: publisher P1 of the article's example, real JPEG frames of the simulated room."""

from __future__ import annotations

import array

from nav_msgs.msg import Odometry
from rclpy.lifecycle import LifecycleState
from sensor_msgs.msg import CompressedImage

from examples.teleop.models import scene
from examples.teleop.models.motion import Pose
from examples.teleop.models.room import ROOM
from examples.teleop.nodes.messages import pose_of
from lifecycle import LifecycleNode, on_message


class Camera(LifecycleNode):
    """Draws what the robot sees from where odometry says it stands."""

    def on_configure(self, _state: LifecycleState) -> None:
        """Take the picture size and set the frame timer, which runs only while active."""
        self._size_px = (self.get_parameter("width").value, self.get_parameter("height").value)
        self._pose = Pose()
        rate_hz = self.get_parameter("rate_hz").value
        self._timer = self.create_timer(1 / rate_hz, self._take_frame)

    def on_cleanup(self, _state: LifecycleState) -> None:
        """Take back the timer, or configuring again would start a second one."""
        self.destroy_timer(self._timer)

    @on_message("odometry")
    def _move(self, message: Odometry) -> None:
        self._pose = pose_of(message)

    def _take_frame(self) -> None:
        now = self.get_clock().now()
        message = CompressedImage(format="jpeg")
        message.header.stamp = now.to_msg()
        message.header.frame_id = "camera"
        picture = scene.render(ROOM, self._pose, now.nanoseconds / 1e9, self._size_px)
        # array.array is taken as it is; bytes would be checked one integer at a time.
        message.data = array.array("B", scene.encode(picture))
        self.publisher("video").publish(message)
