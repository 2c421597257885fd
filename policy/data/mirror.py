"""Flights in a mirror: left and right exchanged.

The mirror is the plane of the first and third axis, of the world and of the body: vectors change
the sign of y, rotations those of x and z. It holds in both state frames.
"""

import numpy as np
from numpy.typing import NDArray

from policy.contract import (
    QUATERNION,
    RATE,
    ROTATION,
    SPECIFIC_FORCE,
    STATE_DIM,
    VELOCITY,
    VELOCITY_CHANGE,
    FloatArray,
)

_VECTOR, _AXIAL = (1.0, -1.0, 1.0), (-1.0, 1.0, -1.0)
STICK_SIGNS = np.array((1.0, -1.0, 1.0, -1.0), np.float32)
"""Factors of throttle, yaw, pitch and roll."""
GATE_SIGNS = np.array((*_VECTOR, -1.0, *_VECTOR), np.float32)
"""Factors of what ``flight_data.GATE_DIM`` describes."""


def state_signs(state_dim: int) -> FloatArray:
    """Factors [state_dim] of a state."""
    signs = np.ones(state_dim, np.float32)
    signs[VELOCITY] = signs[SPECIFIC_FORCE] = _VECTOR
    signs[RATE] = signs[QUATERNION.start + 1 : QUATERNION.stop] = _AXIAL
    if state_dim > STATE_DIM:
        signs[ROTATION] = _AXIAL
        signs[VELOCITY_CHANGE] = _VECTOR
    return signs


def mirrored(values: FloatArray, signs: FloatArray, is_mirrored: NDArray[np.bool_]) -> FloatArray:
    """``values`` [B, ..., D], times ``signs`` [D] where ``is_mirrored`` [B]."""
    chosen = is_mirrored.reshape(-1, *[1] * (values.ndim - 1))
    return np.where(chosen, values * signs, values).astype(np.float32)
