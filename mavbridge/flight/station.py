"""Keeps the place of a vehicle that a policy has brought to a stop.

A network without memory can hold its speed near zero, not its place: what is left of the speed adds
up. While the vehicle stands still, the velocity in the policy's state therefore includes a share of
the displacement since then, like a proportional position controller around the policy. A policy
that brakes until this velocity is zero returns to the place.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mavbridge.core.clock import NS_PER_S
from mavbridge.core.records import FloatArray, VehicleState
from policy.contract import VELOCITY

STILL_MPS = 0.5
"""Speed below which a vehicle stands still."""
STILL_NS = NS_PER_S
"""Time for which it must stand still before its place is kept."""
LEFT_MPS = 1.5
"""Speed at which the place is given up, because the policy flies on."""
GAIN_PER_S = 0.5
"""Velocity per displacement."""
MAX_DISPLACEMENT_M = 1.5
"""Largest displacement that counts, along each axis."""
MAX_GAP_NS = NS_PER_S // 2
"""Longest time between two velocities; after a longer one the displacement is unknown."""


@dataclass(slots=True)
class StationKeeper:
    """Integrates the velocity of one flight while the vehicle stands still."""

    _still_ns: int = 0
    """Time since which the vehicle has been standing still, or has kept its place."""
    _newest_ns: int = 0
    _displacement_m: NDArray[np.float64] | None = None
    """[3] in the axes of the state; None: no place is kept."""

    def corrected(self, measured: VehicleState, states: FloatArray) -> FloatArray:
        """Return the policy's ``states`` [1, ..., S] with the displacement in their velocity.

        Call at each solve with the newest state as measured.
        """
        velocity_mps = measured.values[VELOCITY].astype(np.float64)
        speed_mps = float(np.linalg.norm(velocity_mps))
        now_ns, passed_ns = measured.velocity_ns, measured.velocity_ns - self._newest_ns
        self._newest_ns = now_ns
        is_kept = self._displacement_m is not None
        if passed_ns > MAX_GAP_NS or speed_mps > (LEFT_MPS if is_kept else STILL_MPS):
            self._still_ns, self._displacement_m = now_ns, None
        elif self._displacement_m is not None:
            self._displacement_m += velocity_mps * (passed_ns / NS_PER_S)
        elif now_ns - self._still_ns >= STILL_NS:
            self._displacement_m = np.zeros(3)
        if self._displacement_m is None:
            return states
        corrected = states.copy()
        near_m = np.clip(self._displacement_m, -MAX_DISPLACEMENT_M, MAX_DISPLACEMENT_M)
        corrected[..., VELOCITY] += (GAIN_PER_S * near_m).astype(np.float32)
        return corrected
