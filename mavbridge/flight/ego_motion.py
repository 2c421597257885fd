"""Image age and motion since exposure, optional inputs appended to the state."""

from collections import deque

import numpy as np

from mavbridge.core.clock import NS_PER_S
from mavbridge.core.records import FloatArray, VehicleState
from mavbridge.core.vehicle import Reading
from policy.contract import (
    AGE,
    QUATERNION,
    ROTATION,
    SINCE_EXPOSURE_DIM,
    STATE_DIM,
    VELOCITY,
    VELOCITY_CHANGE,
)
from policy.motion.rotation import motion_since_exposure, slerp

MAX_READINGS = 1024
"""Attitudes, and velocities, kept: five seconds of the fastest attitude stream that a link
carries."""


class EgoMotion:
    """History of attitude and velocity, each by its own stamp; for one thread.

    Works in the frame of the pushed states, NED/FRD or ENU/FLU.
    """

    def __init__(self, *, span_ns: int) -> None:
        self._span_ns = span_ns
        self._attitudes: deque[Reading] = deque(maxlen=MAX_READINGS)
        self._velocities: deque[Reading] = deque(maxlen=MAX_READINGS)

    def push(self, state: VehicleState) -> None:
        """Add a state. A part that is not newer than the last one is ignored."""
        values = state.values.tolist()
        self._remember(self._attitudes, Reading(state.attitude_ns, tuple(values[QUATERNION])))
        self._remember(self._velocities, Reading(state.velocity_ns, tuple(values[VELOCITY])))

    def append_to(self, state: VehicleState, exposed_ns: int) -> FloatArray:
        """Return the state [13] with ``contract.SINCE_EXPOSURE_NAMES`` appended, [1, 20] float32.

        Args:
            state: newest pushed state.
            exposed_ns: exposure of the image. If it is after the attitude, the motion is zero
                and the age negative.

        Raises:
            ValueError: no state was pushed.
        """
        if not self._attitudes:
            raise ValueError("no state was pushed, so none can have moved")
        out = np.empty((1, STATE_DIM + SINCE_EXPOSURE_DIM), np.float32)
        out[0, :STATE_DIM] = state.values
        a, b, c, d = state.values[QUATERNION].tolist()
        vx, vy, vz = state.values[VELOCITY].tolist()
        before, after, share = _around(self._attitudes, exposed_ns)
        (pw, px, py, pz), (qw, qx, qy, qz) = before.values, after.values
        attitude_then = slerp((pw, px, py, pz), (qw, qx, qy, qz), share)
        before, after, share = _around(self._velocities, exposed_ns)
        ux, uy, uz = (p + share * (q - p) for p, q in zip(before.values, after.values, strict=True))
        velocity_change = (vx - ux, vy - uy, vz - uz)
        turn, change = motion_since_exposure(attitude_then, (a, b, c, d), velocity_change)
        out[0, AGE] = (state.attitude_ns - exposed_ns) / NS_PER_S
        out[0, ROTATION], out[0, VELOCITY_CHANGE] = turn, change
        return out

    def _remember(self, readings: deque[Reading], new: Reading) -> None:
        if readings and new.arrived_ns <= readings[-1].arrived_ns:
            return
        readings.append(new)
        # One reading from before the span stays: an exposure lies between two.
        while len(readings) > 1 and readings[1].arrived_ns <= new.arrived_ns - self._span_ns:
            readings.popleft()


def _around(readings: deque[Reading], at_ns: int) -> tuple[Reading, Reading, float]:
    """Return the readings before and after a time, and its position between them, 0 to 1."""
    after = readings[-1]
    for before in reversed(readings):  # from the newest: an image is a few readings old
        if before.arrived_ns <= at_ns:
            between_ns = after.arrived_ns - before.arrived_ns
            return before, after, (at_ns - before.arrived_ns) / between_ns if between_ns else 0.0
        after = before
    return after, after, 0.0
