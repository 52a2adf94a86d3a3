"""What the camera sees: the room in perspective, a ball that rolls through it, and the time.

Owns: drawing frames and encoding them as JPEG with Pillow. Pure but for Pillow.
"""

from __future__ import annotations

import functools
import io
import math

from PIL import Image, ImageDraw

from examples.teleop.models.motion import Pose, normalized_angle
from examples.teleop.models.room import Room

_FIELD_OF_VIEW_RAD = math.radians(75)
_STRIP_PX = 4  # one ray per strip: 80 rays for 320 columns, about 1 ms
_CEILING = (58, 66, 82)
_FLOOR = (96, 88, 78)
_WALL = (214, 206, 190)
_BALL = (222, 74, 44)
_BALL_RADIUS_M = 0.18
_EYE_HEIGHT_M = 0.5
_WALL_HEIGHT_M = 2.2
_JPEG_QUALITY = 70


def ball_position(time_s: float) -> tuple[float, float]:
    """Return where the ball is at a time, in metres: an ellipse about the room's middle, 12 s."""
    phase = math.tau * time_s / 12
    return 2.6 * math.cos(phase), 2.2 * math.sin(phase)


def render(room: Room, pose: Pose, time_s: float, size_px: tuple[int, int]) -> Image.Image:
    """Return the picture seen from `pose`, 75 degrees wide, RGB.

    Args:
        room: what stands around.
        pose: of the camera.
        time_s: seconds since the epoch; moves the ball and is written into the picture.
        size_px: width and height, each >= 16.
    """
    width, height = size_px
    image = _background(size_px).copy()
    draw = ImageDraw.Draw(image)
    focal_px = width / 2 / math.tan(_FIELD_OF_VIEW_RAD / 2)
    depth_m = _draw_walls(draw, room, pose, size_px, focal_px)
    _draw_ball(draw, pose=pose, time_s=time_s, size_px=size_px, focal_px=focal_px, depth_m=depth_m)
    draw.rectangle((0, height - 14, width, height), fill=(0, 0, 0))
    text = f"t={time_s:.3f}  x={pose.x_m:+.2f}  y={pose.y_m:+.2f}"
    draw.text((4, height - 13), text, fill=(230, 230, 230))
    return image


def encode(image: Image.Image) -> bytes:
    """Return the picture as a JPEG file."""
    buffer = io.BytesIO()
    image.save(buffer, format="JPEG", quality=_JPEG_QUALITY)
    return buffer.getvalue()


def decode(data: bytes) -> Image.Image:
    """Return the picture in a JPEG file, decoded to the last pixel.

    Raises:
        ValueError: the data is not a whole JPEG file.
    """
    try:
        image = Image.open(io.BytesIO(data), formats=("JPEG",))
        image.load()
    except (OSError, SyntaxError) as error:
        raise ValueError(f"cannot decode {len(data)} bytes as a JPEG picture: {error}") from error
    return image


def _draw_walls(
    draw: ImageDraw.ImageDraw,
    room: Room,
    pose: Pose,
    size_px: tuple[int, int],
    focal_px: float,
) -> list[float]:
    """Draw one strip per ray; return each strip's depth, so that nearer things can hide others."""
    width, height = size_px
    depth_m = []
    for left in range(0, width, _STRIP_PX):
        offset_px = width / 2 - (left + _STRIP_PX / 2)
        angle_rad = math.atan2(offset_px, focal_px)
        # The depth along the optical axis, not the ray's length, or walls would look curved.
        distance_m = room.cast(pose.x_m, pose.y_m, pose.yaw_rad + angle_rad) * math.cos(angle_rad)
        distance_m = max(distance_m, 0.05)
        depth_m.append(distance_m)
        top = height / 2 - focal_px * (_WALL_HEIGHT_M - _EYE_HEIGHT_M) / distance_m
        bottom = height / 2 + focal_px * _EYE_HEIGHT_M / distance_m
        light = 1 / (1 + 0.15 * distance_m)
        colour = tuple(round(channel * light) for channel in _WALL)
        draw.rectangle((left, top, left + _STRIP_PX - 1, bottom), fill=colour)
    return depth_m


def _draw_ball(
    draw: ImageDraw.ImageDraw,
    *,
    pose: Pose,
    time_s: float,
    size_px: tuple[int, int],
    focal_px: float,
    depth_m: list[float],
) -> None:
    width, height = size_px
    ball_x_m, ball_y_m = ball_position(time_s)
    dx, dy = ball_x_m - pose.x_m, ball_y_m - pose.y_m
    bearing_rad = normalized_angle(math.atan2(dy, dx) - pose.yaw_rad)
    if abs(bearing_rad) >= _FIELD_OF_VIEW_RAD / 2:
        return
    distance_m = max(math.hypot(dx, dy) * math.cos(bearing_rad), 0.2)
    centre_px = width / 2 - focal_px * math.tan(bearing_rad)
    strip = min(int(centre_px) // _STRIP_PX, len(depth_m) - 1)
    if distance_m > depth_m[strip]:
        return  # behind a wall
    radius_px = focal_px * _BALL_RADIUS_M / distance_m
    middle_px = height / 2 + focal_px * (_EYE_HEIGHT_M - _BALL_RADIUS_M) / distance_m
    draw.ellipse(
        (
            centre_px - radius_px,
            middle_px - radius_px,
            centre_px + radius_px,
            middle_px + radius_px,
        ),
        fill=_BALL,
    )


@functools.lru_cache(maxsize=4)
def _background(size_px: tuple[int, int]) -> Image.Image:
    width, height = size_px
    image = Image.new("RGB", size_px, _CEILING)
    image.paste(_FLOOR, (0, height // 2, width, height))
    return image
