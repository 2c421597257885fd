"""Inner loops: attitude or body rate to angular acceleration; velocity to lean and thrust.

The gains of the attitude and velocity loops are PX4's parameters. Those of the rate loop were
chosen so that a step of rate or attitude takes as long as measured on PX4's SIH; PX4's rate
parameters only scale them.
"""

import math
from collections import deque
from typing import TypeAlias

from sitl.clock import NS_PER_MS, NS_PER_S
from sitl.px4.params import DEFAULT_RATE_P, Px4Params
from sitl.vehicle.dynamics import GRAVITY_MPS2, Airframe, BodyState, clamp, shorten
from sitl.vehicle.rotation import (
    Quat,
    Vec3,
    conjugate,
    from_euler,
    multiply,
    rotate,
    rotation_between,
    to_heading,
)

STEP_NS = 4 * NS_PER_MS
STEP_S = STEP_NS / NS_PER_S
SIH_QUAD = Airframe(
    mass_kg=1.0,
    max_motor_thrust_n=GRAVITY_MPS2 / 4.0 / 0.484,  # hovers at 0.484 of full thrust
    motor_lag_s=0.05,
    rotor_drag_nspm=1.0,  # 6.8 m/s at a lean of 35 degrees
    air_density_kgpm3=0.0,
    step_ns=1_000_000,
)
HOVER_THRUST = 0.484

NorthEast: TypeAlias = tuple[float, float]
STILL: NorthEast = (0.0, 0.0)

RATE_GAIN_PER_S = 14.0  # roll and pitch, at the default MC_ROLLRATE_P and MC_PITCHRATE_P
YAW_GAIN_PER_S = 2.6
TARGET_DELAY_STEPS = 9  # control steps from an attitude demand to its effect: 36 ms
YAW_TORQUE_LAG_S = 0.08  # MC_YAW_TQ_CUTOFF 2 Hz
MAX_VELOCITY_INTEGRAL_MPS2 = 4.0
HOLD_BELOW_MPS = 0.3  # braking ends at this speed, and the present position is held
BRAKING_PER_S = 1.0  # in POSCTL with centred sticks
MOVING_MPS = 0.5
REACTION_S = 0.85  # time for which AUTO keeps a moving vehicle's lean before it brakes, as measured


class RateController:
    """Tracks body rates, and attitudes through them."""

    def __init__(self, params: Px4Params) -> None:
        self._params = params
        self._yaw_accel_radps2 = 0.0
        self._targets: deque[tuple[Quat, float]] = deque(maxlen=TARGET_DELAY_STEPS + 1)
        self.rates_radps: Vec3 = (0.0, 0.0, 0.0)
        """Demanded body rates, as ATTITUDE_TARGET reports them."""

    def reset(self) -> None:
        self._yaw_accel_radps2 = 0.0
        self._targets.clear()
        self.rates_radps = (0.0, 0.0, 0.0)

    def attitude(self, body: BodyState, target: Quat, yaw_rate_radps: float) -> Vec3:
        """Return the angular acceleration towards an attitude that turns about the vertical."""
        self._targets.append((target, yaw_rate_radps))
        target, yaw_rate_radps = self._targets[0]
        turned_rad = yaw_rate_radps * STEP_S * (len(self._targets) - 1)  # turn since the demand
        target = multiply(from_euler(0.0, 0.0, turned_rad), target)
        error = rotation_between(body.ned_from_body_wxyz, target)
        gains = [self._params[f"MC_{axis}_P"] for axis in ("ROLL", "PITCH", "YAW")]
        down_body = rotate(conjugate(body.ned_from_body_wxyz), (0.0, 0.0, 1.0))
        roll, pitch, yaw = (
            gain * angle + yaw_rate_radps * down
            for gain, angle, down in zip(gains, error, down_body, strict=True)
        )
        return self.rates(body, (roll, pitch, yaw))

    def rates(self, body: BodyState, wanted_radps: Vec3) -> Vec3:
        """Return the angular acceleration towards body rates, each limited to its MC_*RATE_MAX."""
        limits = [self._params[f"MC_{axis}RATE_MAX"] for axis in ("ROLL", "PITCH", "YAW")]
        roll, pitch, yaw = (
            clamp(rate, math.radians(limit))
            for rate, limit in zip(wanted_radps, limits, strict=True)
        )
        self.rates_radps = (roll, pitch, yaw)
        roll_share, pitch_share = (
            self._params[name] / DEFAULT_RATE_P for name in ("MC_ROLLRATE_P", "MC_PITCHRATE_P")
        )
        actual = body.rate_body_radps
        yaw_accel = YAW_GAIN_PER_S * (yaw - actual[2])
        self._yaw_accel_radps2 += (yaw_accel - self._yaw_accel_radps2) * STEP_S / YAW_TORQUE_LAG_S
        return (
            roll_share * RATE_GAIN_PER_S * (roll - actual[0]),
            pitch_share * RATE_GAIN_PER_S * (pitch - actual[1]),
            self._yaw_accel_radps2,
        )


class VelocityController:
    """Tracks a horizontal velocity by leaning, with proportional, integral and damping terms."""

    def __init__(self, params: Px4Params) -> None:
        self._params = params
        self._integral = [0.0, 0.0]
        self._last_mps: NorthEast | None = None
        self._accel = [0.0, 0.0]

    def reset(self, accel_ne_mps2: NorthEast) -> None:
        """Start with this acceleration in the integral, as if wind and drag required it."""
        self._integral = list(accel_ne_mps2)
        self._last_mps = None
        self._accel = [0.0, 0.0]

    def update(
        self, body: BodyState, wanted_ne_mps: NorthEast, feedforward_ne_mps2: NorthEast = (0.0, 0.0)
    ) -> NorthEast:
        """Return the acceleration north and east [m/s^2], limited by MPC_TILTMAX_AIR."""
        params = self._params
        actual = body.velocity_ned_mps[:2]
        last = actual if self._last_mps is None else self._last_mps
        limit = GRAVITY_MPS2 * math.tan(math.radians(params["MPC_TILTMAX_AIR"]))
        accel = []
        for axis in range(2):
            error = wanted_ne_mps[axis] - actual[axis]
            self._accel[axis] += 0.1 * ((actual[axis] - last[axis]) / STEP_S - self._accel[axis])
            self._integral[axis] = clamp(
                self._integral[axis] + params["MPC_XY_VEL_I_ACC"] * error * STEP_S,
                MAX_VELOCITY_INTEGRAL_MPS2,
            )
            damping = params["MPC_XY_VEL_D_ACC"] * self._accel[axis]
            wanted = params["MPC_XY_VEL_P_ACC"] * error + self._integral[axis] - damping
            accel.append(wanted + feedforward_ne_mps2[axis])
        self._last_mps = (actual[0], actual[1])
        return shorten((accel[0], accel[1]), limit)


class Horizontal:
    """Horizontal motion of the modes that need a position: paths and their velocity controller.

    In POSCTL the sticks accelerate the target velocity against drag. AUTO modes follow a path of
    limited jerk to a position. OFFBOARD tracks the demanded velocity directly.
    """

    def __init__(self, params: Px4Params) -> None:
        self._params = params
        self._velocity = VelocityController(params)
        self.accel_mps2 = STILL  # last demanded acceleration
        self.speed_mps = STILL  # last demanded velocity
        self._path_accel = STILL
        self._place_m: NorthEast | None = None  # on the path, or held by POSCTL
        self._stop_m = STILL
        self._reaction_s = 0.0

    def reset(self, body: BodyState, accel_mps2: NorthEast) -> None:
        self._velocity.reset(accel_mps2)
        self.accel_mps2 = accel_mps2
        self.speed_mps = (body.velocity_ned_mps[0], body.velocity_ned_mps[1])
        self._path_accel = STILL
        self._place_m = None
        self._reaction_s = REACTION_S if math.hypot(*self.speed_mps) > MOVING_MPS else 0.0

    def track(self, velocity_mps: NorthEast, body: BodyState) -> NorthEast:
        """Track an OFFBOARD velocity, limited to MPC_XY_VEL_MAX."""
        self.speed_mps = shorten(velocity_mps, self._params["MPC_XY_VEL_MAX"])
        return self._follow(self.speed_mps, STILL, body)

    def steer(self, wanted_mps: NorthEast, body: BodyState) -> NorthEast:
        """Approach the velocity of POSCTL's sticks; with centred sticks, stop and hold."""
        params = self._params
        full = 2.0 * params["MPC_ACC_HOR"]  # at full stick, before drag
        per_s = full / max(0.1, params["MPC_VEL_MANUAL"])
        if wanted_mps == STILL:
            per_s = BRAKING_PER_S
        gaps = [per_s * (w - v) for w, v in zip(wanted_mps, self.speed_mps, strict=True)]
        self._approach((gaps[0], gaps[1]), full, params["MPC_JERK_MAX"])
        if wanted_mps != STILL:
            self._place_m = None
        elif self._place_m is None and math.hypot(*self.speed_mps) < HOLD_BELOW_MPS:
            self._place_m = _place(body)
        if self._place_m is None:
            return self._follow(self.speed_mps, self._path_accel, body)
        self.speed_mps = self._path_accel = STILL
        return self._follow(self._towards(self._place_m, body), STILL, body)

    def fly_to(self, target_m: NorthEast | None, body: BodyState) -> NorthEast:
        """Fly to a position north and east of home, in AUTO modes; None: brake to a stop."""
        params = self._params
        if self._reaction_s > 0.0:
            self._reaction_s -= STEP_S
            self.speed_mps = (body.velocity_ned_mps[0], body.velocity_ned_mps[1])
            return self.accel_mps2
        accel, jerk = max(0.1, params["MPC_ACC_HOR"]), max(0.1, params["MPC_JERK_AUTO"])
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
        self._approach((scale * gaps[0], scale * gaps[1]), accel, jerk)
        north, east = self._place_m
        self._place_m = (north + self.speed_mps[0] * STEP_S, east + self.speed_mps[1] * STEP_S)
        correction = self._towards(self._place_m, body)
        velocity = (self.speed_mps[0] + correction[0], self.speed_mps[1] + correction[1])
        return self._follow(velocity, self._path_accel, body)

    def _approach(self, wanted: NorthEast, limit: float, jerk: float) -> None:
        """Move the path's acceleration towards the wanted one, and integrate its velocity."""
        wanted = shorten(wanted, limit)
        step = jerk * STEP_S
        now_n, now_e = self._path_accel
        accel_n = now_n + clamp(wanted[0] - now_n, step)
        accel_e = now_e + clamp(wanted[1] - now_e, step)
        self._path_accel = (accel_n, accel_e)
        self.speed_mps = (
            self.speed_mps[0] + accel_n * STEP_S,
            self.speed_mps[1] + accel_e * STEP_S,
        )

    def _towards(self, place_m: NorthEast, body: BodyState) -> NorthEast:
        gain = self._params["MPC_XY_P"]
        north, east = body.position_ned_m[:2]
        offset = (gain * (place_m[0] - north), gain * (place_m[1] - east))
        return shorten(offset, self._params["MPC_XY_CRUISE"])

    def _follow(self, velocity: NorthEast, feedforward: NorthEast, body: BodyState) -> NorthEast:
        self.accel_mps2 = self._velocity.update(body, velocity, feedforward)
        return self.accel_mps2


def _place(body: BodyState) -> NorthEast:
    return body.position_ned_m[0], body.position_ned_m[1]


def attitude_for(accel_ne_mps2: NorthEast, yaw_rad: float) -> Quat:
    """Return the attitude whose thrust gives this horizontal acceleration in level flight."""
    north, east = accel_ne_mps2
    forward, right = to_heading(north, east, yaw_rad)
    roll = math.asin(right / math.sqrt(forward**2 + right**2 + GRAVITY_MPS2**2))
    return from_euler(roll, math.atan2(-forward, GRAVITY_MPS2), yaw_rad)
