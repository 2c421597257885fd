"""Attitude arithmetic on plain floats, several times cheaper than arrays at these sizes.

Quaternions are unit, w first, and named by the frames that they join: ``ned_from_body`` rotates
body (FRD) vectors into NED. Euler angles are yaw, then pitch, then roll (aerospace order).
"""

import math
from collections.abc import Iterable, Sequence
from typing import TypeAlias

Vec3: TypeAlias = tuple[float, float, float]
Quat: TypeAlias = tuple[float, float, float, float]

IDENTITY: Quat = (1.0, 0.0, 0.0, 0.0)


def vec3(values: Iterable[float]) -> Vec3:
    x, y, z = values
    return (x, y, z)


def minus(a: Vec3, b: Vec3) -> Vec3:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def plus(a: Vec3, b: Vec3, factor: float = 1.0) -> Vec3:
    """Return a + factor * b."""
    return (a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2])


def norm(q: Sequence[float]) -> float:
    w, x, y, z = q
    return math.sqrt(w * w + x * x + y * y + z * z)


def normalised(q: Sequence[float]) -> Quat:
    """Return the quaternion of unit length."""
    size = norm(q)
    return (q[0] / size, q[1] / size, q[2] / size, q[3] / size)


def multiply(a: Quat, b: Quat) -> Quat:
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def conjugate(q: Quat) -> Quat:
    w, x, y, z = q
    return (w, -x, -y, -z)


def rotate(q: Quat, v: Vec3) -> Vec3:
    """Rotate a vector into the frame on the left of the quaternion's name."""
    w, x, y, z = q
    vx, vy, vz = v
    tx = 2.0 * (y * vz - z * vy)
    ty = 2.0 * (z * vx - x * vz)
    tz = 2.0 * (x * vy - y * vx)
    return (
        vx + w * tx + y * tz - z * ty,
        vy + w * ty + z * tx - x * tz,
        vz + w * tz + x * ty - y * tx,
    )


def from_euler(roll: float, pitch: float, yaw: float) -> Quat:
    cr, sr = math.cos(roll / 2.0), math.sin(roll / 2.0)
    cp, sp = math.cos(pitch / 2.0), math.sin(pitch / 2.0)
    cy, sy = math.cos(yaw / 2.0), math.sin(yaw / 2.0)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def to_euler(q: Quat) -> Vec3:
    """Return roll, pitch and yaw [rad]; pitch is within +-pi/2."""
    w, x, y, z = q
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x))))
    yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return roll, pitch, yaw


def rotation_between(start: Quat, end: Quat) -> Vec3:
    """Return the rotation vector from one attitude to another, in axes of the first: axis times
    angle [rad] of the shorter way round."""
    w, x, y, z = multiply(conjugate(start), end)
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    sine = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 if sine < 1e-9 else 2.0 * math.atan2(sine, w) / sine
    return (x * scale, y * scale, z * scale)


def integrate(q: Quat, rate_body_radps: Vec3, dt_s: float) -> Quat:
    """Return the attitude after ``dt_s`` at a constant body rate, renormalised."""
    wx, wy, wz = rate_body_radps
    rate = math.sqrt(wx * wx + wy * wy + wz * wz)
    half = 0.5 * rate * dt_s
    scale = 0.5 * dt_s if half < 1e-9 else math.sin(half) / rate
    return normalised(multiply(q, (math.cos(half), wx * scale, wy * scale, wz * scale)))


def cos_tilt(q: Quat) -> float:
    """Return the cosine of the angle between body down and NED down: 1 level, 0 on its side."""
    _, x, y, _ = q
    return 1.0 - 2.0 * (x * x + y * y)


def wrap_pi(angle: float) -> float:
    return math.remainder(angle, 2.0 * math.pi)


def yaw_of(q: Quat) -> float:
    return to_euler(q)[2]


def horizontal(vector_ned: Vec3) -> complex:
    """Return the horizontal part, north + 1j * east.

    A product with ``cmath.rect(1.0, yaw)`` rotates forward + 1j * right into north and east.
    """
    return complex(vector_ned[0], vector_ned[1])


def length(vector: complex) -> float:
    """Return the length; unlike ``abs``, it is the same with every platform's C library."""
    return math.hypot(vector.real, vector.imag)
