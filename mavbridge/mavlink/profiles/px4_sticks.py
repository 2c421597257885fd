"""Motion of PX4's multicopters for given sticks, by their parameters.

Formulas: PX4's ``Sticks``, ``StickTiltXY``, ``StickYaw``, ``FlightTaskManualAltitude`` and, for
STABILIZED, ``mc_att_control``. The tests compare them with leans and rates measured on the
firmware.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

from mavbridge.core.vehicle import StickGains
from mavbridge.mavlink.profiles.sticks import (
    IDENTITY,
    MAX_DEAD_ZONE,
    Axis,
    Bend,
    Half,
    Lean,
    StickCurves,
    curves_between,
    unusable,
)

EXPO = 0.6
"""Expo of the yaw and climb sticks: cubic fraction; the default of older versions too."""
_LEAN_MODES = ("ALTCTL", "STABILIZED")
"""Modes in which sticks are a lean and a yaw rate."""
_CLIMB_MODE = "ALTCTL"
_MAX_TILT_DEG = 89.0
_LEAST_EXPO = 1e-3
"""Expo below which the curve counts as a straight line."""
_LEAST_LINEAR = 1e-9
"""Linear fraction below which the curve counts as a cube."""


class CubicExpo(NamedTuple):
    """Expo curve (1 - e) x + e x^3."""

    expo: float

    def bent(self, share: float) -> float:
        """Return the fraction of the motion at this fraction of the stick."""
        return share * (1.0 - self.expo + self.expo * share * share)

    def straightened(self, share: float) -> float:
        """Return the fraction of the stick: the real root, by Cardano's hyperbolic formula."""
        linear = 1.0 - self.expo
        if linear < _LEAST_LINEAR:
            return math.cbrt(share)
        root = math.sqrt(linear / (3.0 * self.expo))
        return 2.0 * root * math.sinh(math.asinh(1.5 * share / (linear * root)) / 3.0)


def px4_curves(values: Mapping[str, float], mode: str, gains: StickGains | None) -> StickCurves:
    """Return the map from the policy's sticks to those of a PX4 multicopter with these parameters.

    ALTCTL maps all sticks, STABILIZED all but the throttle, which is thrust there. In other modes
    sticks have meanings that ``gains`` does not cover (a speed in POSCTL, a body rate in ACRO) and
    stay unchanged; all stay unchanged if ``gains`` is None.
    """
    if gains is None or mode not in _LEAN_MODES:
        return IDENTITY
    dead_zone = "MPC_HOLD_DZ" if "MPC_HOLD_DZ" in values else "MAN_DEADZONE"
    positive = ("MPC_MAN_TILT_MAX", "MPC_MAN_Y_MAX", "MPC_Z_VEL_MAX_UP", "MPC_Z_VEL_MAX_DN")
    needed = (*positive, dead_zone)
    if (nothing := unusable(values, needed=needed, positive=positive)) is not None:
        return nothing
    start = min(max(values[dead_zone], 0.0), MAX_DEAD_ZONE)
    climb = _expo(values, "MPC_Z_MAN_EXPO")

    def half(parameter: str, bend: Bend | None) -> Half:
        return Half(values[parameter], start, bend=bend, parameter=parameter)

    throttle = Axis(half("MPC_Z_VEL_MAX_UP", climb), half("MPC_Z_VEL_MAX_DN", climb))
    return curves_between(
        gains,
        throttle=throttle if mode == _CLIMB_MODE else None,
        yaw=Axis.even(half("MPC_MAN_Y_MAX", _expo(values, "MPC_YAW_EXPO"))),
        lean=_lean(values["MPC_MAN_TILT_MAX"], is_tangent=mode == _CLIMB_MODE),
    )


def _expo(values: Mapping[str, float], name: str) -> Bend | None:
    expo = min(max(values.get(name, EXPO), 0.0), 1.0)
    return CubicExpo(expo) if expo >= _LEAST_EXPO else None


def _lean(tilt_deg: float, *, is_tangent: bool) -> Lean:
    """Return the lean: no dead zone; an acceleration in ALTCTL, a tilt in STABILIZED."""
    tilt_deg = min(tilt_deg, _MAX_TILT_DEG)
    full = math.tan(math.radians(tilt_deg)) if is_tangent else tilt_deg
    axis = Axis.even(Half(full))
    return Lean(axis, axis, full, is_tangent, "MPC_MAN_TILT_MAX")
