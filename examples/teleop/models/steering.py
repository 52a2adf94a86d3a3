"""How the operator drives: round a list of waypoints, turning before driving.

Owns: the driving pattern. A `Tour` never looks at a clock; it reacts to where the robot is. Pure.
"""

from __future__ import annotations

import dataclasses
import math

from examples.teleop.models.motion import Pose, Velocity, normalized_angle

SQUARE = ((2.0, -1.6), (2.0, 1.6), (-2.0, 1.6), (-2.0, -1.6))
"""Round the cupboard in the room's middle, counterclockwise, in metres."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Tour:
    """An endless round trip.

    Attributes:
        waypoints: (x, y) in metres, at least one.
        target: index of the waypoint to drive to next.
        cruise_mps: speed on the straights, > 0.
        reached_m: a waypoint counts as reached within this distance, > 0.
    """

    waypoints: tuple[tuple[float, float], ...] = SQUARE
    target: int = 0
    cruise_mps: float = 0.5
    reached_m: float = 0.3

    def advanced(self, pose: Pose) -> Tour:
        """Return the tour with the next target if the robot stands at this one."""
        x_m, y_m = self.waypoints[self.target]
        if math.hypot(x_m - pose.x_m, y_m - pose.y_m) > self.reached_m:
            return self
        return dataclasses.replace(self, target=(self.target + 1) % len(self.waypoints))

    def command(self, pose: Pose) -> Velocity:
        """Return the velocity that leads from `pose` to the target.

        Forward speed falls with the cosine of the heading error and is 0 beyond a right angle, so
        that the robot turns on the spot rather than in a wide arc.
        """
        x_m, y_m = self.waypoints[self.target]
        error_rad = normalized_angle(math.atan2(y_m - pose.y_m, x_m - pose.x_m) - pose.yaw_rad)
        return Velocity(
            forward_mps=self.cruise_mps * max(0.0, math.cos(error_rad)) ** 2,
            turn_radps=max(-1.2, min(1.2, 2.0 * error_rad)),
        )
