"""How old the image is and how the vehicle moved since: what a contract may append to the state."""

import math
from collections import deque

import numpy as np

from mavbridge.core.clock import NS_PER_S
from mavbridge.core.records import FloatArray, Reading, VehicleState
from policy.contract import (
    AGE,
    QUATERNION,
    ROTATION,
    SINCE_EXPOSURE_DIM,
    STATE_DIM,
    VELOCITY,
    VELOCITY_CHANGE,
)

MAX_READINGS = 1024
"""Of each kind: five seconds of the fastest attitude stream that a link carries."""

_Vector = tuple[float, float, float]
_Quaternion = tuple[float, float, float, float]


class EgoMotion:
    """Remembers attitude and velocity, each by its own stamp; for one thread.

    All is in the frame of the states that are pushed, so the same code serves NED/FRD and ENU/FLU.
    """

    def __init__(self, *, span_ns: int) -> None:
        self._span_ns = span_ns
        self._attitudes: deque[Reading] = deque(maxlen=MAX_READINGS)
        self._velocities: deque[Reading] = deque(maxlen=MAX_READINGS)

    def push(self, state: VehicleState) -> None:
        """Remember a state; a part that is not newer than the last one is known already."""
        values = state.values.tolist()
        self._remember(self._attitudes, Reading(state.attitude_ns, tuple(values[QUATERNION])))
        self._remember(self._velocities, Reading(state.velocity_ns, tuple(values[VELOCITY])))

    def append_to(self, state: VehicleState, exposed_ns: int) -> FloatArray:
        """The state [13] and ``contract.SINCE_EXPOSURE_NAMES`` behind it -> [1, 20] float32.

        Args:
            state: the newest of those that were pushed.
            exposed_ns: when the image was taken. Between two readings the body is taken to turn at
                a constant rate and to accelerate evenly. Before the first one it is taken to have
                been as it was then, and after the last one as it is now: the motion of an image
                that is newer than the attitude is zero. The age is what it is, below zero too.

        Raises:
            ValueError: nothing was pushed.
        """
        if not self._attitudes:
            raise ValueError("no state was pushed, so none can have moved")
        out = np.empty((1, STATE_DIM + SINCE_EXPOSURE_DIM), np.float32)
        out[0, :STATE_DIM] = state.values
        w, x, y, z = _attitude_at(self._attitudes, exposed_ns)
        exposed_from_world = (w, -x, -y, -z)
        a, b, c, d = state.values[QUATERNION].tolist()
        was = _velocity_at(self._velocities, exposed_ns)
        vx, vy, vz = state.values[VELOCITY].tolist()
        change = (vx - was[0], vy - was[1], vz - was[2])
        out[0, AGE] = (state.attitude_ns - exposed_ns) / NS_PER_S
        out[0, ROTATION] = _rotation_vector(_product(exposed_from_world, (a, b, c, d)))
        out[0, VELOCITY_CHANGE] = _rotated(exposed_from_world, change)
        return out

    def _remember(self, readings: deque[Reading], new: Reading) -> None:
        if readings and new.arrived_ns <= readings[-1].arrived_ns:
            return
        readings.append(new)
        # One reading from before the span stays: an exposure lies between two.
        while len(readings) > 1 and readings[1].arrived_ns <= new.arrived_ns - self._span_ns:
            readings.popleft()


def _around(readings: deque[Reading], at_ns: int) -> tuple[Reading, Reading, float]:
    """The readings before and after a time, and its share of the way between them."""
    after = readings[-1]
    for before in reversed(readings):  # from the newest: an image is a few readings old
        if before.arrived_ns <= at_ns:
            way_ns = after.arrived_ns - before.arrived_ns
            return before, after, (at_ns - before.arrived_ns) / way_ns if way_ns else 0.0
        after = before
    return after, after, 0.0


def _attitude_at(readings: deque[Reading], at_ns: int) -> _Quaternion:
    before, after, share = _around(readings, at_ns)
    w, x, y, z = before.values
    if share == 0.0:
        return w, x, y, z
    a, b, c, d = after.values
    turn = _rotation_vector(_product((w, -x, -y, -z), (a, b, c, d)))
    return _product((w, x, y, z), _quaternion(turn, share))


def _velocity_at(readings: deque[Reading], at_ns: int) -> _Vector:
    before, after, share = _around(readings, at_ns)
    (px, py, pz), (qx, qy, qz) = before.values, after.values
    return px + share * (qx - px), py + share * (qy - py), pz + share * (qz - pz)


def _product(p: _Quaternion, q: _Quaternion) -> _Quaternion:
    """Hamilton's product of two wxyz quaternions."""
    w, x, y, z = p
    a, b, c, d = q
    return (
        w * a - x * b - y * c - z * d,
        w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    )


def _rotation_vector(q: _Quaternion) -> _Vector:
    """Axis times angle in [0, pi], of q and -q alike."""
    w, x, y, z = q if q[0] >= 0 else (-q[0], -q[1], -q[2], -q[3])
    sine = math.sqrt(x * x + y * y + z * z)
    scale = 2 * math.atan2(sine, w) / sine if sine > 0 else 2.0
    return scale * x, scale * y, scale * z


def _quaternion(rotation: _Vector, share: float) -> _Quaternion:
    """A share of a rotation vector as a wxyz quaternion."""
    x, y, z = rotation
    angle = math.sqrt(x * x + y * y + z * z)
    half = 0.5 * share * angle
    scale = math.sin(half) / angle if angle > 0 else 0.5 * share
    return math.cos(half), scale * x, scale * y, scale * z


def _rotated(q: _Quaternion, v: _Vector) -> _Vector:
    """``q v q*`` of a unit quaternion, as ``v + 2 u x (u x v + w v)`` with u its vector part."""
    w, x, y, z = q
    a, b, c = v
    sx, sy, sz = y * c - z * b + w * a, z * a - x * c + w * b, x * b - y * a + w * c
    return a + 2 * (y * sz - z * sy), b + 2 * (z * sx - x * sz), c + 2 * (x * sy - y * sx)
