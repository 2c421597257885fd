"""Conversions between Euler angles (MAVLink's intrinsic Z-Y-X convention) and ned_from_body."""

import math
from collections.abc import Sequence
from typing import TypeAlias

Quaternion: TypeAlias = tuple[float, float, float, float]
"""w, x, y, z."""


def quaternion_from_euler(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Quaternion:
    """Return the unit quaternion of these angles."""
    cr, sr = math.cos(roll_rad / 2), math.sin(roll_rad / 2)
    cp, sp = math.cos(pitch_rad / 2), math.sin(pitch_rad / 2)
    cy, sy = math.cos(yaw_rad / 2), math.sin(yaw_rad / 2)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def heading_rad(ned_from_body_wxyz: Sequence[float]) -> float:
    """Return the yaw angle, clockwise from north."""
    w, x, y, z = ned_from_body_wxyz
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def roll_pitch_rad(ned_from_body_wxyz: Sequence[float]) -> tuple[float, float]:
    """Return roll (+ right side down) and pitch (+ nose up)."""
    w, x, y, z = ned_from_body_wxyz
    roll_rad = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    return roll_rad, math.asin(min(max(2 * (w * y - z * x), -1.0), 1.0))


def tilt_rad(ned_from_body_wxyz: Sequence[float]) -> float:
    """Return the angle between the body's and the world's down axes: 0 upright, pi upside down."""
    _, x, y, _ = ned_from_body_wxyz
    return 2 * math.asin(min(math.hypot(x, y), 1.0))
