"""The room the robot drives in: walls and pillars, and rays cast against them.

Owns: the map and the lidar's geometry. The map is constant; where the robot stands in it is never
stored here, whoever needs that learns it from odometry. Pure.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable

from examples.teleop.models.motion import Pose, normalized_angle


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Wall:
    """A straight wall between two points, in metres."""

    x1_m: float
    y1_m: float
    x2_m: float
    y2_m: float

    def distance(self, x_m: float, y_m: float, dx: float, dy: float) -> float:
        """Return how far the ray from (x, y) along the unit vector (dx, dy) runs to this wall.

        Infinite where it misses.
        """
        ex, ey = self.x2_m - self.x1_m, self.y2_m - self.y1_m
        cross = dx * ey - dy * ex
        if abs(cross) < 1e-12:
            return math.inf  # parallel
        ox, oy = self.x1_m - x_m, self.y1_m - y_m
        along_ray = (ox * ey - oy * ex) / cross
        along_wall = (ox * dy - oy * dx) / cross
        return along_ray if along_ray >= 0 and 0 <= along_wall <= 1 else math.inf


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Pillar:
    """A round pillar, in metres."""

    x_m: float
    y_m: float
    radius_m: float

    def distance(self, x_m: float, y_m: float, dx: float, dy: float) -> float:
        """Return how far the ray from (x, y) along the unit vector (dx, dy) runs to this pillar."""
        ox, oy = self.x_m - x_m, self.y_m - y_m
        ahead = ox * dx + oy * dy
        half_chord_squared = self.radius_m**2 - (ox * ox + oy * oy - ahead * ahead)
        if half_chord_squared < 0:
            return math.inf
        distance = ahead - math.sqrt(half_chord_squared)
        return distance if distance >= 0 else math.inf


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Room:
    """Everything that a ray can hit."""

    walls: tuple[Wall, ...]
    pillars: tuple[Pillar, ...] = ()

    def cast(self, x_m: float, y_m: float, angle_rad: float) -> float:
        """Return the distance from (x, y) to the first thing in this direction, in metres."""
        dx, dy = math.cos(angle_rad), math.sin(angle_rad)
        nearest = math.inf
        for wall in self.walls:
            nearest = min(nearest, wall.distance(x_m, y_m, dx, dy))
        for pillar in self.pillars:
            nearest = min(nearest, pillar.distance(x_m, y_m, dx, dy))
        return nearest

    def scan(self, pose: Pose, beams: int) -> tuple[float, ...]:
        """Return `beams` distances around the robot, from straight behind counterclockwise.

        Beam i looks at `pose.yaw_rad - pi + i * 2 pi / beams`, as LaserScan's angle_min and
        angle_increment say.
        """
        start_rad = pose.yaw_rad - math.pi
        step_rad = math.tau / beams
        return tuple(
            self.cast(pose.x_m, pose.y_m, start_rad + index * step_rad) for index in range(beams)
        )


def rectangle(left_m: float, bottom_m: float, right_m: float, top_m: float) -> tuple[Wall, ...]:
    """Return the four walls of an axis-aligned rectangle."""
    corners = ((left_m, bottom_m), (right_m, bottom_m), (right_m, top_m), (left_m, top_m))
    return tuple(
        Wall(x1_m=x1, y1_m=y1, x2_m=x2, y2_m=y2)
        for (x1, y1), (x2, y2) in zip(corners, corners[1:] + corners[:1], strict=True)
    )


ROOM = Room(
    walls=rectangle(-4.0, -3.0, 4.0, 3.0) + rectangle(-0.5, -0.4, 0.5, 0.4),
    pillars=(
        Pillar(x_m=3.0, y_m=2.2, radius_m=0.25),
        Pillar(x_m=-3.2, y_m=-2.2, radius_m=0.35),
    ),
)
"""8 m by 6 m with a cupboard in the middle and a pillar in two corners; the robot drives round."""


def clearance(
    ranges_m: Iterable[float], angle_min_rad: float, step_rad: float, half_width_rad: float
) -> float:
    """Return the nearest range within `half_width_rad` of straight ahead; infinite if none."""
    ahead = (
        range_m
        for index, range_m in enumerate(ranges_m)
        if abs(normalized_angle(angle_min_rad + index * step_rad)) <= half_width_rad
    )
    return min(ahead, default=math.inf)
