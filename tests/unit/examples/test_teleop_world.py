"""The example's room, camera pictures, battery and topic meter."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from examples.teleop.models import scene
from examples.teleop.models.battery import (
    Load,
    Pack,
    discharged,
    open_circuit_voltage,
    resting,
)
from examples.teleop.models.motion import STANDSTILL, Pose, Velocity
from examples.teleop.models.room import ROOM, Pillar, Room, Wall, clearance, rectangle
from examples.teleop.models.topic_health import Health, TopicMeter

SIZE = (320, 240)


def test_a_ray_ends_at_the_nearest_thing_in_its_direction() -> None:
    room = Room(
        walls=(*rectangle(-4, -3, 4, 3), Wall(x1_m=2, y1_m=-1, x2_m=2, y2_m=1)),
        pillars=(Pillar(x_m=0, y_m=2, radius_m=0.5),),
    )
    assert room.cast(0, 0, 0) == pytest.approx(2.0)  # the inner wall, not the outer at 4
    assert room.cast(0, 0, math.pi / 2) == pytest.approx(1.5)  # the pillar's near side
    assert room.cast(0, 0, math.pi) == pytest.approx(4.0)
    assert room.cast(0, 0, math.atan2(3, 4)) == pytest.approx(5.0)  # into a corner


def test_a_ray_that_meets_nothing_is_infinite() -> None:
    lonely = Room(walls=(Wall(x1_m=1, y1_m=-1, x2_m=1, y2_m=1),))
    assert lonely.cast(0, 0, math.pi) == math.inf
    assert lonely.cast(0, 0, math.pi / 2) == math.inf  # parallel


def test_beams_start_behind_and_turn_with_the_robot() -> None:
    still = ROOM.scan(Pose(x_m=-2, y_m=-1.6), 4)
    assert still == pytest.approx((2.0, 1.4, 6.0, 4.6))  # behind, right, ahead, left
    turned = ROOM.scan(Pose(x_m=-2, y_m=-1.6, yaw_rad=math.pi / 2), 4)
    assert turned == pytest.approx(still[1:] + still[:1])


@given(st.floats(-1.9, 1.9), st.floats(-2.9, -0.5), st.floats(-math.pi, math.pi))
def test_inside_the_room_every_beam_ends_within_its_diagonal(
    x_m: float, y_m: float, yaw_rad: float
) -> None:
    ranges = ROOM.scan(Pose(x_m=x_m, y_m=y_m, yaw_rad=yaw_rad), 24)
    assert all(0 < each <= 10.0 for each in ranges)


def test_clearance_looks_ahead_only() -> None:
    ranges = (0.1, 0.2, 3.0, 2.5, 3.5, 0.2)  # from behind, 60 degrees apart: 3 is straight ahead
    assert clearance(ranges, -math.pi, math.tau / 6, math.radians(25)) == 2.5
    assert clearance(ranges, -math.pi, math.tau / 6, math.radians(61)) == 2.5
    assert clearance((), -math.pi, 1.0, 1.0) == math.inf


def test_a_frame_is_a_real_jpeg_of_the_size_asked_for() -> None:
    data = scene.encode(scene.render(ROOM, Pose(x_m=-2, y_m=-1.6), 1000.0, SIZE))
    assert data[:3] == b"\xff\xd8\xff"
    picture = scene.decode(data)
    assert (picture.format, picture.size, picture.mode) == ("JPEG", SIZE, "RGB")


def test_the_picture_changes_with_the_pose_and_with_time() -> None:
    here = scene.render(ROOM, Pose(x_m=-2, y_m=-1.6), 0.0, SIZE)
    assert scene.render(ROOM, Pose(x_m=-2, y_m=-1.6), 0.0, SIZE).tobytes() == here.tobytes()
    assert scene.render(ROOM, Pose(x_m=-1, y_m=-1.6), 0.0, SIZE).tobytes() != here.tobytes()
    assert scene.render(ROOM, Pose(x_m=-2, y_m=-1.6), 0.1, SIZE).tobytes() != here.tobytes()


def _ball_pixels(pose: Pose, time_s: float) -> int:
    picture = scene.render(ROOM, pose, time_s, SIZE)
    data = picture.tobytes()
    return sum(data[index : index + 3] == bytes((222, 74, 44)) for index in range(0, len(data), 3))


def test_the_ball_is_seen_when_it_is_ahead_and_not_when_it_is_behind() -> None:
    # At time 0 the ball lies at (2.6, 0).
    assert _ball_pixels(Pose(x_m=1.0), 0.0) > 500
    assert _ball_pixels(Pose(x_m=1.0, yaw_rad=math.pi), 0.0) == 0


def test_a_wall_hides_the_ball() -> None:
    assert _ball_pixels(Pose(x_m=-1.5), 0.0) == 0  # the cupboard stands between


def test_the_nearer_ball_is_the_larger_one() -> None:
    assert _ball_pixels(Pose(x_m=1.6), 0.0) > 2 * _ball_pixels(Pose(x_m=0.6), 0.0)


@pytest.mark.parametrize("cut", [0, 2, 100, 2000])
def test_half_a_frame_is_refused_with_its_size(cut: int) -> None:
    data = scene.encode(scene.render(ROOM, Pose(), 0.0, SIZE))[:cut]
    with pytest.raises(ValueError, match=f"^cannot decode {cut} bytes as a JPEG picture: "):
        scene.decode(data)


def test_an_idle_hour_uses_what_the_idle_load_draws() -> None:
    pack, charge = Pack(), resting(Pack(), 0.9)
    for _ in range(3600):
        charge = discharged(pack, charge, Load().power_w(STANDSTILL), 1.0)
    # 12 W from about 15.7 V is 0.76 A: 0.76 Ah of 5 Ah.
    assert 0.9 - charge.fraction == pytest.approx(0.155, abs=0.01)


def test_driving_draws_more_and_the_voltage_sags() -> None:
    pack, before = Pack(), resting(Pack(), 0.8)
    idle = discharged(pack, before, Load().power_w(STANDSTILL), 1.0)
    driving = discharged(pack, before, Load().power_w(Velocity(forward_mps=0.5)), 1.0)
    assert driving.current_a > 2 * idle.current_a
    assert driving.voltage_v < idle.voltage_v < before.voltage_v
    assert driving.voltage_v * driving.current_a == pytest.approx(42.0)  # 12 + 0.5 * 60


def test_an_empty_pack_delivers_nothing_and_never_goes_below_zero() -> None:
    charge = discharged(Pack(), resting(Pack(), 1e-6), 100.0, 10.0)
    assert charge.fraction == 0.0
    assert discharged(Pack(), charge, 100.0, 10.0) == resting(Pack(), 0.0)


@given(st.floats(0, 1), st.floats(0, 1))
def test_voltage_rises_with_charge(one: float, other: float) -> None:
    low, high = sorted((one, other))
    assert open_circuit_voltage(Pack(), low) <= open_circuit_voltage(Pack(), high)
    assert 12.0 <= open_circuit_voltage(Pack(), low) <= 16.8


def test_a_load_beyond_the_pack_gets_the_most_it_can_deliver() -> None:
    charge = discharged(Pack(), resting(Pack(), 1.0), 1e6, 0.001)
    assert charge.current_a == pytest.approx(16.8 / 2 / 0.08)


def test_a_topic_is_stale_before_its_first_message_and_after_silence() -> None:
    meter = TopicMeter("video", 10.0)
    assert meter.judged(0.0).message == "no message yet"
    for index in range(20):
        meter.arrived(index / 15)
    healthy = meter.judged(19 / 15)
    assert (healthy.health, healthy.message) == (Health.OK, "15.0 Hz")
    silent = meter.judged(19 / 15 + 0.6)
    assert (silent.health, silent.message) == (Health.STALE, "silent for 0.6 s")


def test_a_slow_topic_is_a_warning_with_both_rates() -> None:
    meter = TopicMeter("scan", 5.0)
    for index in range(4):
        meter.arrived(index / 4)
    slow = meter.judged(0.8)
    assert (slow.health, slow.message) == (Health.WARN, "4.0 Hz, expected at least 5.0 Hz")


def test_one_message_alone_says_nothing_of_the_rate() -> None:
    meter = TopicMeter("scan", 5.0)
    meter.arrived(0.0)
    assert (meter.judged(0.1).health, meter.judged(0.1).rate_hz) == (Health.OK, 0.0)
    meter.forget()
    assert (meter.count, meter.judged(0.1).health) == (0, Health.STALE)
