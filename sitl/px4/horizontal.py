"""Horizontal motion of the modes that know where they are: to an acceleration north and east.

POSCTL's sticks push a velocity that drag holds back; AUTO modes follow a path of limited jerk to a
place; OFFBOARD tracks the velocity that is asked for as it is.
"""

import math
from typing import TypeAlias

from sitl.px4.control import VelocityController
from sitl.px4.params import Px4Params
from sitl.vehicle.control import clamp
from sitl.vehicle.dynamics import BodyState

NorthEast: TypeAlias = tuple[float, float]

STILL: NorthEast = (0.0, 0.0)
HOLD_BELOW_MPS = 0.3  # braking ends at this speed, and the place of that moment is held
BRAKING_PER_S = 1.0  # of POSCTL with centred sticks
MOVING_MPS = 0.5
REACTION_S = 0.85
"""How long AUTO keeps the lean of a moving vehicle before it brakes, as measured."""


class Horizontal:
    """Paths and the velocity controller behind them."""

    def __init__(self, params: Px4Params) -> None:
        self._params = params
        self._velocity = VelocityController(params)
        self.accel_mps2 = STILL
        """Acceleration that was asked for last."""
        self.speed_mps = STILL
        """Velocity that was asked for last."""
        self._path_accel = STILL
        self._place_m: NorthEast | None = None  # on the path, or the place that POSCTL holds
        self._stop_m = STILL
        self._reaction_s = 0.0

    def reset(self, body: BodyState, accel_mps2: NorthEast) -> None:
        """Begin in the present motion, with the acceleration that was asked for until now."""
        self._velocity.reset(accel_mps2)
        self.accel_mps2 = accel_mps2
        self.speed_mps = (body.velocity_ned_mps[0], body.velocity_ned_mps[1])
        self._path_accel = STILL
        self._place_m = None
        self._reaction_s = REACTION_S if math.hypot(*self.speed_mps) > MOVING_MPS else 0.0

    def track(self, velocity_mps: NorthEast, body: BodyState, dt_s: float) -> NorthEast:
        """OFFBOARD: a velocity, at most MPC_XY_VEL_MAX."""
        self.speed_mps = shorten(velocity_mps, self._params["MPC_XY_VEL_MAX"])
        return self._follow(self.speed_mps, STILL, body, dt_s)

    def steer(self, wanted_mps: NorthEast, body: BodyState, dt_s: float) -> NorthEast:
        """POSCTL: a velocity that the sticks end up at; held in place once it has come to rest."""
        params = self._params
        full = 2.0 * params["MPC_ACC_HOR"]  # at full stick, before drag
        per_s = full / params["MPC_VEL_MANUAL"]
        if wanted_mps == STILL:
            per_s = BRAKING_PER_S
        gaps = [per_s * (w - v) for w, v in zip(wanted_mps, self.speed_mps, strict=True)]
        self._approach((gaps[0], gaps[1]), full, params["MPC_JERK_MAX"], dt_s)
        if wanted_mps != STILL:
            self._place_m = None
        elif self._place_m is None and math.hypot(*self.speed_mps) < HOLD_BELOW_MPS:
            self._place_m = _place(body)
        if self._place_m is None:
            return self._follow(self.speed_mps, self._path_accel, body, dt_s)
        self.speed_mps = self._path_accel = STILL
        return self._follow(self._towards(self._place_m, body), STILL, body, dt_s)

    def fly_to(self, target_m: NorthEast | None, body: BodyState, dt_s: float) -> NorthEast:
        """AUTO: a place north and east of home; None: where braking ends."""
        params = self._params
        if self._reaction_s > 0.0:
            self._reaction_s -= dt_s
            self.speed_mps = (body.velocity_ned_mps[0], body.velocity_ned_mps[1])
            return self.accel_mps2
        accel, jerk = params["MPC_ACC_HOR"], params["MPC_JERK_AUTO"]
        if self._place_m is None:
            self._place_m = _place(body)
            lead_s = math.hypot(*self.speed_mps) / (2.0 * accel) + accel / (2.0 * jerk)
            pairs = zip(self._place_m, self.speed_mps, strict=True)
            north, east = (place + lead_s * speed for place, speed in pairs)
            self._stop_m = (north, east)
        target = self._stop_m if target_m is None else target_m
        gain = params["MPC_XY_TRAJ_P"]
        offsets = [gain * (t - p) for t, p in zip(target, self._place_m, strict=True)]
        wanted = shorten((offsets[0], offsets[1]), params["MPC_XY_CRUISE"])
        gaps = [w - v for w, v in zip(wanted, self.speed_mps, strict=True)]
        gap = math.hypot(*gaps)
        scale = math.sqrt(2.0 * jerk * gap) / gap if gap > 1e-6 else 0.0
        self._approach((scale * gaps[0], scale * gaps[1]), accel, jerk, dt_s)
        north, east = self._place_m
        self._place_m = (north + self.speed_mps[0] * dt_s, east + self.speed_mps[1] * dt_s)
        correction = self._towards(self._place_m, body)
        velocity = (self.speed_mps[0] + correction[0], self.speed_mps[1] + correction[1])
        return self._follow(velocity, self._path_accel, body, dt_s)

    def _approach(self, wanted: NorthEast, limit: float, jerk: float, dt_s: float) -> None:
        """Turn the path's acceleration towards the wanted one, and its velocity with it."""
        wanted = shorten(wanted, limit)
        step = jerk * dt_s
        now_n, now_e = self._path_accel
        accel_n = now_n + clamp(wanted[0] - now_n, step)
        accel_e = now_e + clamp(wanted[1] - now_e, step)
        self._path_accel = (accel_n, accel_e)
        self.speed_mps = (
            self.speed_mps[0] + accel_n * dt_s,
            self.speed_mps[1] + accel_e * dt_s,
        )

    def _towards(self, place_m: NorthEast, body: BodyState) -> NorthEast:
        gain = self._params["MPC_XY_P"]
        north, east = body.position_ned_m[:2]
        offset = (gain * (place_m[0] - north), gain * (place_m[1] - east))
        return shorten(offset, self._params["MPC_XY_CRUISE"])

    def _follow(
        self, velocity: NorthEast, feedforward: NorthEast, body: BodyState, dt_s: float
    ) -> NorthEast:
        self.accel_mps2 = self._velocity.update(body, velocity, dt_s, feedforward)
        return self.accel_mps2


def shorten(vector: NorthEast, limit: float) -> NorthEast:
    """The vector, or one in its direction of this length where it is longer."""
    scale = limit / max(limit, math.hypot(*vector))
    return vector[0] * scale, vector[1] * scale


def _place(body: BodyState) -> NorthEast:
    return body.position_ned_m[0], body.position_ned_m[1]
