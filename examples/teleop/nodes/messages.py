"""Between the models' plain values and ROS messages; the one place that knows both shapes."""

from __future__ import annotations

from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry

from examples.teleop.models.motion import Pose, Velocity, quaternion_to_yaw, yaw_to_quaternion


def pose_of(odometry: Odometry) -> Pose:
    """Return the pose in an odometry message."""
    pose = odometry.pose.pose
    return Pose(
        x_m=pose.position.x,
        y_m=pose.position.y,
        yaw_rad=quaternion_to_yaw(pose.orientation.z, pose.orientation.w),
    )


def velocity_of(twist: Twist) -> Velocity:
    """Return the part of a Twist that a differential drive can follow."""
    return Velocity(forward_mps=twist.linear.x, turn_radps=twist.angular.z)


def twist(velocity: Velocity) -> Twist:
    """Return a velocity as a message."""
    message = Twist()
    message.linear.x = velocity.forward_mps
    message.angular.z = velocity.turn_radps
    return message


def odometry(pose: Pose, velocity: Velocity) -> Odometry:
    """Return pose and velocity as a message without a stamp, in frames `odom` and `base_link`."""
    message = Odometry()
    message.header.frame_id = "odom"
    message.child_frame_id = "base_link"
    message.pose.pose.position.x = pose.x_m
    message.pose.pose.position.y = pose.y_m
    orientation = message.pose.pose.orientation
    orientation.z, orientation.w = yaw_to_quaternion(pose.yaw_rad)
    message.twist.twist = twist(velocity)
    return message
