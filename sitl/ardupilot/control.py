"""Inner loops: attitude to angular acceleration, height to thrust, both to motors."""

import math

from sitl.ardupilot.params import Params
from sitl.rotation import (
    IDENTITY,
    Vec3,
    conjugate,
    from_euler,
    integrate,
    multiply,
    rotation_vector,
    to_euler,
)
from sitl.vehicle.dynamics import (
    GRAVITY_MPS2,
    INERTIA_KGM2,
    MAX_MOTOR_THRUST_N,
    MOTOR_ARM_M,
    YAW_TORQUE_PER_THRUST_M,
    BodyState,
)

RATE_GAIN_PER_S: Vec3 = (18.0, 18.0, 6.0)
"""With a 28 ms motor lag 18/s keeps the rate loop at a damping ratio of about 0.7."""
MIN_INPUT_TIME_S = 0.01
MAX_TARGET_LEAD_RAD = math.radians(30.0)
"""In rate mode the target may run ahead of the vehicle by this much before it is pulled back."""
SPIN_MIN = 0.05  # lowest thrust of an armed, flying motor
_ANGLE_GAINS = ("ATC_ANG_RLL_P", "ATC_ANG_PIT_P", "ATC_ANG_YAW_P")


def clamp(value: float, limit: float) -> float:
    """The value within +-limit."""
    return max(-limit, min(limit, value))


class AttitudeController:
    """Tracks leans with a yaw rate, or body rates; the target lives here between steps."""

    def __init__(self, params: Params) -> None:
        self._params = params
        self._target = IDENTITY
        self._roll = self._pitch = self._yaw = 0.0
        self._roll_rate = self._pitch_rate = 0.0

    def reset(self, body: BodyState) -> None:
        """Make the present attitude the target: on the ground, and at each mode change."""
        self._target = body.ned_from_body_wxyz
        self._roll, self._pitch, self._yaw = to_euler(body.ned_from_body_wxyz)
        self._roll_rate = self._pitch_rate = 0.0

    def lean(
        self, body: BodyState, roll: float, pitch: float, yaw_rate_radps: float, dt_s: float
    ) -> Vec3:
        """Body angular acceleration (rad/s^2) towards a roll and pitch, turning at a yaw rate."""
        self._roll_rate = self._shape("R", roll - self._roll, self._roll_rate, dt_s)
        self._pitch_rate = self._shape("P", pitch - self._pitch, self._pitch_rate, dt_s)
        self._roll += self._roll_rate * dt_s
        self._pitch += self._pitch_rate * dt_s
        self._yaw += yaw_rate_radps * dt_s
        self._target = from_euler(self._roll, self._pitch, self._yaw)
        sr, cr = math.sin(self._roll), math.cos(self._roll)
        sp, cp = math.sin(self._pitch), math.cos(self._pitch)
        feedforward = (
            self._roll_rate - sp * yaw_rate_radps,
            cr * self._pitch_rate + sr * cp * yaw_rate_radps,
            -sr * self._pitch_rate + cr * cp * yaw_rate_radps,
        )
        return self._track(body, feedforward)

    def rates(self, body: BodyState, rate_radps: Vec3, dt_s: float) -> Vec3:
        """Body angular acceleration (rad/s^2) towards a body rate; zero holds the attitude."""
        self._target = integrate(self._target, rate_radps, dt_s)
        error = rotation_vector(multiply(conjugate(body.ned_from_body_wxyz), self._target))
        if math.hypot(*error) > MAX_TARGET_LEAD_RAD:
            self._target = body.ned_from_body_wxyz
        return self._track(body, rate_radps)

    def _track(self, body: BodyState, feedforward_radps: Vec3) -> Vec3:
        error = rotation_vector(multiply(conjugate(body.ned_from_body_wxyz), self._target))
        gains = [self._params[name] for name in _ANGLE_GAINS]
        ax, ay, az = (
            RATE_GAIN_PER_S[k]
            * (feedforward_radps[k] + gains[k] * error[k] - body.rate_body_radps[k])
            for k in range(3)
        )
        return (ax, ay, az)

    def _shape(self, axis: str, error_rad: float, rate_radps: float, dt_s: float) -> float:
        """Next rate of a target angle that closes its error without a jump in rate."""
        input_time_s = max(MIN_INPUT_TIME_S, self._params.decimal("ATC_INPUT_TC"))
        max_rate_radps = math.radians(self._limit(f"ATC_RATE_{axis}_MAX"))
        max_accel_radps2 = math.radians(self._limit(f"ATC_ACCEL_{axis}_MAX") / 100.0)
        wanted = clamp(error_rad / input_time_s, max_rate_radps)
        return rate_radps + clamp(wanted - rate_radps, max_accel_radps2 * dt_s)

    def _limit(self, name: str) -> float:
        """The parameter; infinite where it is 0."""
        limit = self._params[name]
        return limit if limit > 0.0 else math.inf


class HeightController:
    """Climb rate demand to vertical acceleration; holds the height where the demand is zero."""

    HEIGHT_GAIN_PER_S = 1.0
    CLIMB_GAIN_PER_S = 5.0
    INTEGRAL_GAIN_PER_S2 = 2.0
    MAX_INTEGRAL_MPS2 = 3.0
    MAX_HEIGHT_ERROR_M = 2.0
    MAX_ACCEL_MPS2 = 0.7 * GRAVITY_MPS2

    def __init__(self) -> None:
        self._height_m = self._climb_mps = self._integral_mps2 = 0.0

    def reset(self, body: BodyState) -> None:
        """Start from the present height and climb rate."""
        self._height_m = -body.position_ned_m[2]
        self._climb_mps = -body.velocity_ned_mps[2]
        self._integral_mps2 = 0.0

    def update(
        self, body: BodyState, climb_mps: float, max_accel_mps2: float, dt_s: float
    ) -> float:
        """Upward acceleration in m/s^2; the demand itself changes by no more than the limit."""
        height, climb = -body.position_ned_m[2], -body.velocity_ned_mps[2]
        self._climb_mps += clamp(climb_mps - self._climb_mps, max_accel_mps2 * dt_s)
        self._height_m += self._climb_mps * dt_s
        self._height_m = height + clamp(self._height_m - height, self.MAX_HEIGHT_ERROR_M)
        wanted = self._climb_mps + self.HEIGHT_GAIN_PER_S * (self._height_m - height)
        error = wanted - climb
        self._integral_mps2 = clamp(
            self._integral_mps2 + self.INTEGRAL_GAIN_PER_S2 * error * dt_s, self.MAX_INTEGRAL_MPS2
        )
        accel = self.CLIMB_GAIN_PER_S * error + self._integral_mps2
        return clamp(accel, self.MAX_ACCEL_MPS2)


def thrust_for(accel_up_mps2: float, cos_tilt: float, hover: float) -> float:
    """Collective in [0, 1] for a vertical acceleration; the tilt boost ends at 60 degrees."""
    return max(0.0, min(1.0, hover * (1.0 + accel_up_mps2 / GRAVITY_MPS2) / max(cos_tilt, 0.5)))


_ROLL_SIGN = (-1.0, 1.0, 1.0, -1.0)
_PITCH_SIGN = (1.0, -1.0, 1.0, -1.0)
_YAW_SIGN = (1.0, 1.0, -1.0, -1.0)


def mix(collective: float, angular_accel_radps2: Vec3) -> tuple[float, ...]:
    """Four motor commands in [SPIN_MIN, 1]: attitude first, then thrust, yaw with what is left."""
    ix, iy, iz = INERTIA_KGM2
    ax, ay, az = angular_accel_radps2
    per_arm = 4.0 * MOTOR_ARM_M * MAX_MOTOR_THRUST_N
    roll = clamp(ax * ix / per_arm, 0.25)
    pitch = clamp(ay * iy / per_arm, 0.25)
    yaw_room = max(0.05, 0.45 - abs(roll) - abs(pitch))
    yaw = clamp(az * iz / (4.0 * YAW_TORQUE_PER_THRUST_M * MAX_MOTOR_THRUST_N), yaw_room)
    turns = tuple(
        r * roll + p * pitch + y * yaw
        for r, p, y in zip(_ROLL_SIGN, _PITCH_SIGN, _YAW_SIGN, strict=True)
    )
    collective = max(SPIN_MIN - min(turns), min(1.0 - max(turns), collective))
    return tuple(max(SPIN_MIN, min(1.0, collective + turn)) for turn in turns)
