"""Rotations as unit quaternions (w, x, y, z), world_from_body; shared by flight and training.

Every function takes tuples of floats, as the 100 Hz loop has them, or arrays: [..., 4] quaternions
and [..., 3] vectors. It returns the same kind.
"""

import math
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

V = TypeVar("V", Vector, Array)
State = TypeVar("State", tuple[float, ...], Array)
Q = TypeVar("Q", Quaternion, Array)
Kind = TypeVar("Kind")


def multiply(p: Q, q: Q) -> Q:
    """Return the Hamilton product ``p * q``: first ``q``, then ``p``."""
    w, x, y, z = _parts(p)
    a, b, c, d = _parts(q)
    return _like(
        p,
        w * a - x * b - y * c - z * d,
        w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    )


def conjugate(q: Q) -> Q:
    """Return the inverse rotation."""
    w, x, y, z = _parts(q)
    return _like(q, w, -x, -y, -z)


def rotate(q: Q, vector: V) -> V:
    """Rotate a vector from body to world axes; with the conjugate, from world to body axes."""
    w, x, y, z = _parts(q)
    a, b, c = _parts(vector)
    # q v q* = v + 2 u x (u x v + w v), where u is the vector part of q.
    sx, sy, sz = y * c - z * b + w * a, z * a - x * c + w * b, x * b - y * a + w * c
    return _like(
        vector, a + 2 * (y * sz - z * sy), b + 2 * (z * sx - x * sz), c + 2 * (x * sy - y * sx)
    )


def other_frame(state: State) -> State:
    """Convert a state [..., 13] between NED/FRD and ENU/FLU (REP 103); its own inverse.

    Also converts seven numbers: a position and an attitude. The attitude may come out with w < 0.
    """
    x, y, z, qw, qx, qy, qz, *body = _parts(state)
    h = math.sqrt(0.5)
    # Half turns about the diagonal between north and east, and about the nose.
    attitude = (h * (qw + qz), h * (qx + qy), h * (qx - qy), h * (qw - qz))
    signs = (1, -1, -1, 1, -1, -1)
    turned = (sign * value for sign, value in zip(signs, body, strict=False))
    return _like(state, y, x, -z, *attitude, *turned)


def matrix_columns(w: Any, x: Any, y: Any, z: Any) -> tuple[tuple[Any, Any, Any], ...]:
    """Return the columns of world_from_body: the body's axes in the world; any number type."""
    x_axis = (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y))
    y_axis = (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x))
    z_axis = (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y))
    return x_axis, y_axis, z_axis


def level_heading(q: Quaternion) -> tuple[float, float]:
    """Return cosine and sine of the heading of the body's first axis."""
    (north, east, _), _, _ = matrix_columns(*q)
    level = max(math.hypot(north, east), 1e-9)
    return north / level, east / level


def rotation_vector(q: Quaternion | Array) -> Any:
    """Return axis times angle in rad, 3 numbers, for the shorter way round."""
    library: Any = math if isinstance(q, tuple) else np
    w, x, y, z = _parts(q)
    sign = library.copysign(1.0, w)
    sine = library.sqrt(x * x + y * y + z * z)
    # No turn has a sine of 0 and no axis: any divisor gives the zero vector.
    scale = sign * 2 * library.atan2(sine, abs(w)) / (sine + (sine == 0))
    return _like(q, scale * x, scale * y, scale * z)


def slerp(p: Q, q: Q, share: Any) -> Q:
    """Return the attitude after ``share`` (float or [...]) of a steady turn from ``p`` to ``q``."""
    library: Any = math if isinstance(p, tuple) else np
    x, y, z = _parts(rotation_vector(multiply(conjugate(p), q)))
    angle = library.sqrt(x * x + y * y + z * z)
    half = 0.5 * share * angle
    scale = library.sin(half) / (angle + (angle == 0))
    return multiply(p, _like(p, library.cos(half), scale * x, scale * y, scale * z))


def motion_since_exposure(
    attitude_then: Q, attitude_now: Q, velocity_change_world: V
) -> tuple[V, V]:
    """Return rotation vector (rad) and change of velocity (m/s) in body axes at the exposure.

    Between two readings, angular velocity and acceleration are constant; before the first and after
    the last reading both are zero.
    """
    body_from_world = conjugate(attitude_then)
    turn: V = rotation_vector(multiply(body_from_world, attitude_now))
    return turn, rotate(body_from_world, velocity_change_world)


def _parts(values: Any) -> Any:
    """Return the components, each a float or an array [...]."""
    return values if isinstance(values, tuple) else np.moveaxis(values, -1, 0)


def _like(example: Kind, *parts: Any) -> Kind:
    return cast(Kind, parts if isinstance(example, tuple) else np.stack(parts, axis=-1))
