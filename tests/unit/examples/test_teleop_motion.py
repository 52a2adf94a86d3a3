"""The base's kinematics and the operator's steering."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from examples.teleop.models.motion import (
    STANDSTILL,
    CommandWatch,
    DriveLimits,
    Pose,
    Velocity,
    accelerated,
    guarded,
    moved,
    normalized_angle,
    quaternion_to_yaw,
    yaw_to_quaternion,
)
from examples.teleop.models.room import ROOM, clearance
from examples.teleop.models.steering import SQUARE, Tour


def test_straight_driving_follows_the_heading() -> None:
    pose = moved(Pose(yaw_rad=math.pi / 2), Velocity(forward_mps=0.5), 4.0)
    assert (pose.x_m, pose.y_m, pose.yaw_rad) == pytest.approx((0.0, 2.0, math.pi / 2))


def test_a_half_circle_ends_one_diameter_to_the_left() -> None:
    pose = moved(Pose(), Velocity(forward_mps=1.0, turn_radps=1.0), math.pi)
    assert (pose.x_m, pose.y_m) == pytest.approx((0.0, 2.0))
    assert abs(pose.yaw_rad) == pytest.approx(math.pi)


@given(
    st.floats(-1, 1), st.floats(-3, 3), st.floats(0.01, 2), st.integers(min_value=1, max_value=20)
)
def test_many_small_steps_lead_where_one_large_one_does(
    forward: float, turn: float, duration_s: float, steps: int
) -> None:
    velocity = Velocity(forward_mps=forward, turn_radps=turn)
    pose = Pose(x_m=1.0, y_m=-2.0, yaw_rad=0.3)
    whole = moved(pose, velocity, duration_s)
    for _ in range(steps):
        pose = moved(pose, velocity, duration_s / steps)
    assert (pose.x_m, pose.y_m) == pytest.approx((whole.x_m, whole.y_m), abs=1e-9)
    assert normalized_angle(pose.yaw_rad - whole.yaw_rad) == pytest.approx(0, abs=1e-9)


@given(st.floats(-math.pi, math.pi))
def test_a_yaw_survives_the_quaternion(yaw_rad: float) -> None:
    back = quaternion_to_yaw(*yaw_to_quaternion(yaw_rad))
    assert normalized_angle(back - yaw_rad) == pytest.approx(0, abs=1e-9)


def test_speed_rises_no_faster_than_the_motors_can() -> None:
    limits = DriveLimits(forward_mps=0.8, forward_mps2=1.0, turn_radps=1.5, turn_radps2=4.0)
    wanted = Velocity(forward_mps=5.0, turn_radps=-9.0)
    velocity = accelerated(STANDSTILL, wanted, limits, 0.1)
    assert (velocity.forward_mps, velocity.turn_radps) == pytest.approx((0.1, -0.4))
    for _ in range(20):
        velocity = accelerated(velocity, wanted, limits, 0.1)
    assert velocity == Velocity(forward_mps=0.8, turn_radps=-1.5)


def test_a_command_is_obeyed_until_it_is_stale() -> None:
    watch = CommandWatch(timeout_s=0.5)
    assert watch.wanted(0.0) == STANDSTILL
    watch.command(Velocity(forward_mps=0.3), 10.0)
    assert watch.wanted(10.5) == Velocity(forward_mps=0.3)
    assert watch.wanted(10.6) == STANDSTILL
    watch.command(Velocity(forward_mps=0.3), 11.0)
    watch.clear()
    assert watch.wanted(11.0) == STANDSTILL


def test_the_guard_stops_driving_into_things_but_not_turning_or_backing_away() -> None:
    ahead = Velocity(forward_mps=0.5, turn_radps=1.0)
    back = Velocity(forward_mps=-0.5)
    assert guarded(ahead, 0.4, 0.35) == ahead
    assert guarded(ahead, 0.3, 0.35) == Velocity(turn_radps=1.0)
    assert guarded(back, 0.3, 0.35) == back


def test_the_tour_turns_on_the_spot_when_the_target_is_behind() -> None:
    command = Tour(waypoints=((-1.0, 0.0),)).command(Pose(yaw_rad=0.1))
    assert command.forward_mps == 0.0
    assert abs(command.turn_radps) == 1.2


def test_the_tour_drives_round_the_room_and_touches_nothing() -> None:
    pose, velocity, tour = Pose(x_m=-2.0, y_m=-1.6), STANDSTILL, Tour()
    reached = 0
    for _ in range(60 * 20):
        ranges = ROOM.scan(pose, 36)
        ahead_m = clearance(ranges, -math.pi, math.tau / 36, math.radians(25))
        assert min(ranges) > 0.3
        after = tour.advanced(pose)
        reached += after.target != tour.target
        tour = after
        wanted = guarded(tour.command(pose), ahead_m, 0.35)
        velocity = accelerated(velocity, wanted, DriveLimits(), 0.05)
        pose = moved(pose, velocity, 0.05)
    assert reached >= len(SQUARE)
