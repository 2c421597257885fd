"""Inner loops: attitude or body rate to angular acceleration; velocity to lean and thrust.

The gains of the attitude and velocity loops are PX4's parameters. Those of the rate loop were
chosen so that a step of rate or attitude takes as long as measured on PX4's SIH; PX4's rate
parameters only scale them.
"""

import cmath
import math
from collections import deque

from sitl.clock import NS_PER_MS, NS_PER_S
from sitl.px4.params import DEFAULT_RATE_P, Px4Params
from sitl.vehicle.dynamics import GRAVITY_MPS2, Airframe, BodyState, clamp, clamp_axes, shorten
from sitl.vehicle.rotation import (
    Quat,
    Vec3,
    conjugate,
    from_euler,
    horizontal,
    length,
    minus,
    multiply,
    plus,
    rotate,
    rotation_between,
    vec3,
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

STILL = 0j  # horizontal vectors are complex: north + 1j * east

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
        wanted = vec3(gain * angle for gain, angle in zip(gains, error, strict=True))
        return self.rates(body, plus(wanted, down_body, yaw_rate_radps))

    def rates(self, body: BodyState, wanted_radps: Vec3) -> Vec3:
        """Return the angular acceleration towards body rates, each limited to its MC_*RATE_MAX."""
        limits = (self._params[f"MC_{axis}RATE_MAX"] for axis in ("ROLL", "PITCH", "YAW"))
        self.rates_radps = vec3(map(clamp, wanted_radps, map(math.radians, limits)))
        roll_share, pitch_share = (
            self._params[name] / DEFAULT_RATE_P for name in ("MC_ROLLRATE_P", "MC_PITCHRATE_P")
        )
        roll, pitch, yaw = minus(self.rates_radps, body.rate_body_radps)
        yaw_accel = YAW_GAIN_PER_S * yaw
        self._yaw_accel_radps2 += (yaw_accel - self._yaw_accel_radps2) * STEP_S / YAW_TORQUE_LAG_S
        return (
            roll_share * RATE_GAIN_PER_S * roll,
            pitch_share * RATE_GAIN_PER_S * pitch,
            self._yaw_accel_radps2,
        )


class Horizontal:
    """Horizontal motion of the modes that need a position: paths and their velocity controller.

    In POSCTL the sticks accelerate the target velocity against drag. AUTO modes follow a path of
    limited jerk to a position. OFFBOARD tracks the demanded velocity directly.
    """

    def __init__(self, params: Px4Params) -> None:
        self._params = params
        self._integral = self._felt_mps2 = STILL  # of the velocity controller
        self._last_mps: complex | None = None
        self.accel_mps2 = STILL  # last demanded acceleration
        self.speed_mps = STILL  # last demanded velocity
        self._path_accel = STILL
        self._place_m: complex | None = None  # on the path, or held by POSCTL
        self._stop_m = STILL
        self._reaction_s = 0.0

    def reset(self, body: BodyState, accel_mps2: complex) -> None:
        """Start with this acceleration in the integral, as if wind and drag required it."""
        self.accel_mps2 = self._integral = accel_mps2
        self._felt_mps2, self._last_mps = STILL, None
        self.speed_mps = horizontal(body.velocity_ned_mps)
        self._path_accel = STILL
        self._place_m = None
        self._reaction_s = REACTION_S if length(self.speed_mps) > MOVING_MPS else 0.0

    def track(self, velocity_mps: complex, body: BodyState) -> complex:
        """Track an OFFBOARD velocity, limited to MPC_XY_VEL_MAX."""
        self.speed_mps = shorten(velocity_mps, self._params["MPC_XY_VEL_MAX"])
        return self._follow(self.speed_mps, STILL, body)

    def steer(self, wanted_mps: complex, body: BodyState) -> complex:
        """Approach the velocity of POSCTL's sticks; with centred sticks, stop and hold."""
        params = self._params
        full = 2.0 * params["MPC_ACC_HOR"]  # at full stick, before drag
        per_s = full / max(0.1, params["MPC_VEL_MANUAL"])
        if wanted_mps == STILL:
            per_s = BRAKING_PER_S
        self._approach(per_s * (wanted_mps - self.speed_mps), full, params["MPC_JERK_MAX"])
        if wanted_mps != STILL:
            self._place_m = None
        elif self._place_m is None and length(self.speed_mps) < HOLD_BELOW_MPS:
            self._place_m = horizontal(body.position_ned_m)
        if self._place_m is None:
            return self._follow(self.speed_mps, self._path_accel, body)
        self.speed_mps = self._path_accel = STILL
        return self._follow(self._towards(self._place_m, body), STILL, body)

    def fly_to(self, target_m: complex | None, body: BodyState) -> complex:
        """Fly to a position relative to home, in AUTO modes; None: brake to a stop."""
        params = self._params
        if self._reaction_s > 0.0:
            self._reaction_s -= STEP_S
            self.speed_mps = horizontal(body.velocity_ned_mps)
            return self.accel_mps2
        accel, jerk = max(0.1, params["MPC_ACC_HOR"]), max(0.1, params["MPC_JERK_AUTO"])
        if self._place_m is None:
            self._place_m = horizontal(body.position_ned_m)
            lead_s = length(self.speed_mps) / (2.0 * accel) + accel / (2.0 * jerk)
            self._stop_m = self._place_m + lead_s * self.speed_mps
        target = self._stop_m if target_m is None else target_m
        offset = params["MPC_XY_TRAJ_P"] * (target - self._place_m)
        gap = shorten(offset, params["MPC_XY_CRUISE"]) - self.speed_mps
        size = length(gap)
        scale = math.sqrt(2.0 * jerk * size) / size if size > 1e-6 else 0.0
        self._approach(scale * gap, accel, jerk)
        self._place_m += self.speed_mps * STEP_S
        velocity = self.speed_mps + self._towards(self._place_m, body)
        return self._follow(velocity, self._path_accel, body)

    def _approach(self, wanted: complex, limit: float, jerk: float) -> None:
        """Move the path's acceleration towards the wanted one, and integrate its velocity."""
        change = shorten(wanted, limit) - self._path_accel
        self._path_accel += clamp_axes(change, jerk * STEP_S)
        self.speed_mps += self._path_accel * STEP_S

    def _towards(self, place_m: complex, body: BodyState) -> complex:
        offset = self._params["MPC_XY_P"] * (place_m - horizontal(body.position_ned_m))
        return shorten(offset, self._params["MPC_XY_CRUISE"])

    def _follow(self, wanted_mps: complex, feedforward_mps2: complex, body: BodyState) -> complex:
        """Return the acceleration that tracks a velocity, with proportional, integral and damping
        terms, limited by MPC_TILTMAX_AIR."""
        params, actual = self._params, horizontal(body.velocity_ned_mps)
        change = STILL if self._last_mps is None else actual - self._last_mps
        self._last_mps = actual
        self._felt_mps2 += 0.1 * (change / STEP_S - self._felt_mps2)
        error = wanted_mps - actual
        integral = self._integral + params["MPC_XY_VEL_I_ACC"] * error * STEP_S
        self._integral = clamp_axes(integral, MAX_VELOCITY_INTEGRAL_MPS2)
        damping = params["MPC_XY_VEL_D_ACC"] * self._felt_mps2
        wanted = params["MPC_XY_VEL_P_ACC"] * error + self._integral - damping
        limit = GRAVITY_MPS2 * math.tan(math.radians(params["MPC_TILTMAX_AIR"]))
        self.accel_mps2 = shorten(wanted + feedforward_mps2, limit)
        return self.accel_mps2


def attitude_for(accel_mps2: complex, yaw_rad: float) -> Quat:
    """Return the attitude whose thrust gives this horizontal acceleration in level flight."""
    level = accel_mps2 * cmath.rect(1.0, -yaw_rad)
    roll = math.asin(level.imag / math.sqrt(level.real**2 + level.imag**2 + GRAVITY_MPS2**2))
    return from_euler(roll, math.atan2(-level.real, GRAVITY_MPS2), yaw_rad)
