"""How the base moves: pose integration, speed and acceleration limits, stale commands, safety stop.

Owns: the differential drive's kinematics. Times are seconds of any one monotonic clock. Pure.
"""

from __future__ import annotations

import dataclasses
import math


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Pose:
    """Where the robot stands in the room's frame; `yaw_rad` is 0 along +x, counterclockwise."""

    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Velocity:
    """What a Twist says to a differential drive: m/s ahead and rad/s counterclockwise."""

    forward_mps: float = 0.0
    turn_radps: float = 0.0


STANDSTILL = Velocity()


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class DriveLimits:
    """What the motors can do; all values are magnitudes, > 0."""

    forward_mps: float = 0.8
    turn_radps: float = 1.5
    forward_mps2: float = 1.0
    turn_radps2: float = 4.0


def normalized_angle(angle_rad: float) -> float:
    """Return the same direction as an angle in [-pi, pi]."""
    return math.remainder(angle_rad, math.tau)


def yaw_to_quaternion(yaw_rad: float) -> tuple[float, float]:
    """Return (z, w) of the unit quaternion that turns by `yaw_rad` about z; x and y are 0."""
    return math.sin(yaw_rad / 2), math.cos(yaw_rad / 2)


def quaternion_to_yaw(z: float, w: float) -> float:
    """Return the yaw of a quaternion whose x and y are 0, in [-pi, pi]."""
    return normalized_angle(2 * math.atan2(z, w))


def moved(pose: Pose, velocity: Velocity, duration_s: float) -> Pose:
    """Return the pose after driving with a constant velocity: exactly on the arc, not by Euler."""
    turned_rad = velocity.turn_radps * duration_s
    distance_m = velocity.forward_mps * duration_s
    # The chord of the arc is sin(a/2)/(a/2) times the arc itself; its limit at a = 0 is 1.
    half_rad = turned_rad / 2
    chord_m = distance_m * (math.sin(half_rad) / half_rad if abs(half_rad) > 1e-9 else 1.0)
    heading_rad = pose.yaw_rad + half_rad
    return Pose(
        x_m=pose.x_m + chord_m * math.cos(heading_rad),
        y_m=pose.y_m + chord_m * math.sin(heading_rad),
        yaw_rad=normalized_angle(pose.yaw_rad + turned_rad),
    )


def accelerated(
    current: Velocity, wanted: Velocity, limits: DriveLimits, duration_s: float
) -> Velocity:
    """Return the velocity after `duration_s` of approaching `wanted` within the motors' limits."""
    return Velocity(
        forward_mps=_approach(
            current.forward_mps,
            _clamp(wanted.forward_mps, limits.forward_mps),
            limits.forward_mps2 * duration_s,
        ),
        turn_radps=_approach(
            current.turn_radps,
            _clamp(wanted.turn_radps, limits.turn_radps),
            limits.turn_radps2 * duration_s,
        ),
    )


def guarded(wanted: Velocity, clearance_m: float, stop_distance_m: float) -> Velocity:
    """Return `wanted` without its forward part when something is closer than `stop_distance_m`.

    Turning and backing away stay possible, or the robot could never leave a wall.
    """
    if wanted.forward_mps > 0 and clearance_m < stop_distance_m:
        return Velocity(turn_radps=wanted.turn_radps)
    return wanted


class CommandWatch:
    """Holds the latest velocity command and forgets it when no newer one arrives in time."""

    def __init__(self, timeout_s: float) -> None:
        self._timeout_s = timeout_s
        self._command = STANDSTILL
        self._received_s = -math.inf

    def command(self, velocity: Velocity, now_s: float) -> None:
        """Remember a command that arrived at `now_s`."""
        self._command = velocity
        self._received_s = now_s

    def wanted(self, now_s: float) -> Velocity:
        """Return the command, or standstill once it is older than the timeout."""
        return self._command if now_s - self._received_s <= self._timeout_s else STANDSTILL

    def clear(self) -> None:
        """Forget the command, so that a robot that is activated again stands still."""
        self._received_s = -math.inf


def _clamp(value: float, magnitude: float) -> float:
    return max(-magnitude, min(magnitude, value))


def _approach(current: float, wanted: float, step: float) -> float:
    return current + _clamp(wanted - current, step)
