"""Age of the image and motion since its exposure, which a contract may append to the state."""

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
from policy.rotation import motion_since_exposure, slerp

MAX_READINGS = 1024
"""Readings of each kind: five seconds of the fastest attitude stream that a link carries."""


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
            exposed_ns: exposure of the image. If that was after the attitude, the motion is zero
                and the age negative.

        Raises:
            ValueError: nothing was pushed.
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
    """The readings before and after a time, and how far it is between them, 0 to 1."""
    after = readings[-1]
    for before in reversed(readings):  # from the newest: an image is a few readings old
        if before.arrived_ns <= at_ns:
            between_ns = after.arrived_ns - before.arrived_ns
            return before, after, (at_ns - before.arrived_ns) / between_ns if between_ns else 0.0
        after = before
    return after, after, 0.0
