"""A vehicle's motion in NED world and FRD body axes, from a state in either frame."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mavbridge.core.records import VehicleState
from mavbridge.core.rotation import Quaternion
from policy.contract import QUATERNION, SPECIFIC_FORCE, VELOCITY, StateFrame

_HALF_SQRT2 = math.sqrt(0.5)


class Motion(NamedTuple):
    """Attitude, velocity and acceleration at one time."""

    ned_from_body_wxyz: Quaternion
    velocity_ned_mps: tuple[float, float, float]
    specific_force_body_mps2: tuple[float, float, float]

    @staticmethod
    def of(state: VehicleState, frame: StateFrame) -> "Motion":
        """The motion that a state in this frame tells of."""
        vx, vy, vz = state.values[VELOCITY].tolist()
        w, x, y, z = state.values[QUATERNION].tolist()
        fx, fy, fz = state.values[SPECIFIC_FORCE].tolist()
        if frame == "ned_frd":
            return Motion((w, x, y, z), (vx, vy, vz), (fx, fy, fz))
        # The change from NED/FRD to ENU/FLU (REP 103) undoes itself: half turns about the diagonal
        # between north and east, and about the nose.
        r = _HALF_SQRT2
        attitude = (r * (w + z), r * (x + y), r * (x - y), r * (w - z))
        return Motion(attitude, (vy, vx, -vz), (fx, -fy, -fz))

    @property
    def horizontal_mps2(self) -> NDArray[np.float64]:
        """Acceleration towards north and east, [2]; gravity has no part in it."""
        w, x, y, z = self.ned_from_body_wxyz
        horizontal_from_body = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            ]
        )
        return np.asarray(horizontal_from_body @ np.array(self.specific_force_body_mps2))
