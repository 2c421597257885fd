"""Inner loops: attitude or body rates to angular acceleration; velocity to a lean and thrust.

The gains of the attitude and velocity loops are PX4's parameters. Those of the rate loop are this
vehicle's own, chosen so that a step of rate or attitude takes as long as measured on PX4's SIH;
PX4's parameters of it only scale them.
"""

import math
from collections import deque

from sitl.px4.params import DEFAULT_RATE_P, Px4Params
from sitl.rotation import (
    Quat,
    Vec3,
    conjugate,
    from_euler,
    multiply,
    rotate,
    rotation_vector,
    to_heading,
)
from sitl.vehicle.control import clamp
from sitl.vehicle.dynamics import GRAVITY_MPS2, Airframe, BodyState

SIH_QUAD = Airframe(
    mass_kg=1.0,
    max_motor_thrust_n=GRAVITY_MPS2 / 4.0 / 0.484,  # hovers at 0.484
    motor_lag_s=0.05,
    rotor_drag_nspm=1.0,  # 6.8 m/s at a lean of 35 degrees
    air_density_kgpm3=0.0,
    step_ns=1_000_000,
)
HOVER_THRUST = 0.484

RATE_GAIN_PER_S = 14.0  # roll and pitch, at the default MC_ROLLRATE_P and MC_PITCHRATE_P
YAW_GAIN_PER_S = 2.6
TARGET_DELAY_STEPS = 9
"""Control steps until an attitude that is asked for is flown: 36 ms."""
YAW_TORQUE_LAG_S = 0.08  # MC_YAW_TQ_CUTOFF 2 Hz
MAX_VELOCITY_INTEGRAL_MPS2 = 4.0


class RateController:
    """Tracks body rates, and through them attitudes."""

    def __init__(self, params: Px4Params) -> None:
        self._params = params
        self._yaw_accel_radps2 = 0.0
        self._targets: deque[tuple[Quat, float]] = deque(maxlen=TARGET_DELAY_STEPS + 1)
        self.rates_radps: Vec3 = (0.0, 0.0, 0.0)
        """Demanded body rates, as ATTITUDE_TARGET reports them."""

    def reset(self) -> None:
        """Forget the filtered torque and the targets that are under way."""
        self._yaw_accel_radps2 = 0.0
        self._targets.clear()
        self.rates_radps = (0.0, 0.0, 0.0)

    def attitude(self, body: BodyState, target: Quat, yaw_rate_radps: float, dt_s: float) -> Vec3:
        """Angular acceleration towards an attitude that turns about the vertical at a rate."""
        self._targets.append((target, yaw_rate_radps))
        target, yaw_rate_radps = self._targets[0]
        turned_rad = yaw_rate_radps * dt_s * (len(self._targets) - 1)  # since it was asked for
        target = multiply(from_euler(0.0, 0.0, turned_rad), target)
        error = rotation_vector(multiply(conjugate(body.ned_from_body_wxyz), target))
        gains = [self._params[f"MC_{axis}_P"] for axis in ("ROLL", "PITCH", "YAW")]
        down_body = rotate(conjugate(body.ned_from_body_wxyz), (0.0, 0.0, 1.0))
        roll, pitch, yaw = (
            gain * angle + yaw_rate_radps * down
            for gain, angle, down in zip(gains, error, down_body, strict=True)
        )
        return self.rates(body, (roll, pitch, yaw), dt_s)

    def rates(self, body: BodyState, wanted_radps: Vec3, dt_s: float) -> Vec3:
        """Angular acceleration towards body rates, each within its MC_*RATE_MAX."""
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
        self._yaw_accel_radps2 += (yaw_accel - self._yaw_accel_radps2) * dt_s / YAW_TORQUE_LAG_S
        return (
            roll_share * RATE_GAIN_PER_S * (roll - actual[0]),
            pitch_share * RATE_GAIN_PER_S * (pitch - actual[1]),
            self._yaw_accel_radps2,
        )


class VelocityController:
    """Tracks a horizontal velocity by leaning: proportional, integral and damping terms."""

    def __init__(self, params: Px4Params) -> None:
        self._params = params
        self._integral = [0.0, 0.0]
        self._last_mps: tuple[float, float] | None = None
        self._accel = [0.0, 0.0]

    def reset(self, accel_ne_mps2: tuple[float, float]) -> None:
        """Begin with this acceleration, as if it were what wind and drag need."""
        self._integral = list(accel_ne_mps2)
        self._last_mps = None
        self._accel = [0.0, 0.0]

    def update(
        self,
        body: BodyState,
        wanted_ne_mps: tuple[float, float],
        dt_s: float,
        feedforward_ne_mps2: tuple[float, float] = (0.0, 0.0),
    ) -> tuple[float, float]:
        """Acceleration north and east in m/s^2, within MPC_TILTMAX_AIR."""
        params = self._params
        actual = body.velocity_ned_mps[:2]
        last = actual if self._last_mps is None else self._last_mps
        limit = GRAVITY_MPS2 * math.tan(math.radians(params["MPC_TILTMAX_AIR"]))
        accel = []
        for axis in range(2):
            error = wanted_ne_mps[axis] - actual[axis]
            self._accel[axis] += 0.1 * ((actual[axis] - last[axis]) / dt_s - self._accel[axis])
            self._integral[axis] = clamp(
                self._integral[axis] + params["MPC_XY_VEL_I_ACC"] * error * dt_s,
                MAX_VELOCITY_INTEGRAL_MPS2,
            )
            damping = params["MPC_XY_VEL_D_ACC"] * self._accel[axis]
            wanted = params["MPC_XY_VEL_P_ACC"] * error + self._integral[axis] - damping
            accel.append(wanted + feedforward_ne_mps2[axis])
        self._last_mps = (actual[0], actual[1])
        scale = limit / max(limit, math.hypot(*accel))
        return accel[0] * scale, accel[1] * scale


def attitude_for(accel_ne_mps2: tuple[float, float], yaw_rad: float) -> Quat:
    """The attitude whose thrust gives this horizontal acceleration in level flight."""
    north, east = accel_ne_mps2
    forward, right = to_heading(north, east, yaw_rad)
    roll = math.asin(right / math.sqrt(forward**2 + right**2 + GRAVITY_MPS2**2))
    return from_euler(roll, math.atan2(-forward, GRAVITY_MPS2), yaw_rad)
