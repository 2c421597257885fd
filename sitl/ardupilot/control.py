"""Inner loops: lean, attitude or body rate to angular acceleration; acceleration to lean."""

import cmath
import math

from sitl.ardupilot.params import DEFAULT_RATE_P, ArduPilotParams
from sitl.clock import NS_PER_S
from sitl.vehicle.config import STEP_NS
from sitl.vehicle.dynamics import GRAVITY_MPS2, BodyState, clamp
from sitl.vehicle.rotation import (
    IDENTITY,
    Quat,
    Vec3,
    cos_tilt,
    from_euler,
    integrate,
    minus,
    plus,
    rotation_between,
    to_euler,
    vec3,
    yaw_of,
)

STEP_S = STEP_NS / NS_PER_S

RATE_GAIN_PER_S: Vec3 = (18.0, 18.0, 6.0)
"""At the default gains. With 28 ms of motor lag, 18/s gives a damping ratio of about 0.7."""
MIN_INPUT_TIME_S = 0.01
MOTOR_LAG_S = 0.028
CATCH_UP_PER_S = 1.0
YAW_GAIN_PER_S = 6.0
YAW_LAG_S = 0.1
_RATE_GAINS = ("ATC_RAT_RLL_P", "ATC_RAT_PIT_P")
_ANGLE_GAINS = ("ATC_ANG_RLL_P", "ATC_ANG_PIT_P", "ATC_ANG_YAW_P")


class AttitudeController:
    """Tracks leans, attitudes or body rates, and keeps their target between steps."""

    def __init__(self, params: ArduPilotParams) -> None:
        self._params = params
        self._target = IDENTITY
        self._target_rate_radps: Vec3 = (0.0, 0.0, 0.0)
        self._roll = self._pitch = self._yaw = 0.0
        self._roll_rate = self._pitch_rate = 0.0
        self._response = _Response()

    @property
    def target(self) -> tuple[Quat, Vec3]:
        """Shaped target of the last step: attitude (NED from body) and body rates [rad/s]."""
        return self._target, self._target_rate_radps

    def reset(self, body: BodyState) -> None:
        """Make the present attitude the target: on the ground, and at each mode change."""
        self._set_target(body.ned_from_body_wxyz)
        self._target_rate_radps = (0.0, 0.0, 0.0)
        self._response.reset(body)

    def lean(self, body: BodyState, roll: float, pitch: float, yaw_rate_radps: float) -> Vec3:
        """Return body angular acceleration [rad/s^2] towards a roll and pitch, with a yaw rate."""
        self._roll_rate = self._shape("R", roll - self._roll, self._roll_rate)
        self._pitch_rate = self._shape("P", pitch - self._pitch, self._pitch_rate)
        self._roll += self._roll_rate * STEP_S
        self._pitch += self._pitch_rate * STEP_S
        self._yaw += yaw_rate_radps * STEP_S
        self._target = from_euler(self._roll, self._pitch, self._yaw)
        sr, cr = math.sin(self._roll), math.cos(self._roll)
        sp, cp = math.sin(self._pitch), math.cos(self._pitch)
        feedforward = (
            self._roll_rate - sp * yaw_rate_radps,
            cr * self._pitch_rate + sr * cp * yaw_rate_radps,
            -sr * self._pitch_rate + cr * cp * yaw_rate_radps,
        )
        return self._track(body, self._target, feedforward)

    def approach(self, body: BodyState, ned_from_body_wxyz: Quat, rate_body_radps: Vec3) -> Vec3:
        """Return body angular acceleration [rad/s^2] towards an attitude turning at a body rate."""
        error = rotation_between(self._target, ned_from_body_wxyz)
        shaped = map(self._shape, "RPY", error, self._target_rate_radps, rate_body_radps)
        return self._advance(body, vec3(shaped))

    def turn(self, body: BodyState, rate_body_radps: Vec3) -> Vec3:
        """Return body angular acceleration [rad/s^2] towards a body rate, without target jumps.

        As in the firmware, the target does not wait for the vehicle. The vehicle later makes up for
        the angle that it lost at the start, so a weak axis overshoots its rate.
        """
        return self._advance(
            body, vec3(map(self.slew, "RPY", rate_body_radps, self._target_rate_radps))
        )

    def _advance(self, body: BodyState, rate_radps: Vec3) -> Vec3:
        self._set_target(integrate(self._target, rate_radps, STEP_S))
        feedforward = self._response.step(self._target, rate_radps)
        accel = self._track(body, self._response.attitude, self._response.rate_radps)
        self._target_rate_radps = rate_radps
        return plus(accel, feedforward)

    def _set_target(self, ned_from_body_wxyz: Quat) -> None:
        self._target = ned_from_body_wxyz
        self._roll, self._pitch, self._yaw = to_euler(ned_from_body_wxyz)
        self._roll_rate = self._pitch_rate = 0.0

    def _track(self, body: BodyState, attitude: Quat, feedforward_radps: Vec3) -> Vec3:
        self._target_rate_radps = feedforward_radps
        error = rotation_between(body.ned_from_body_wxyz, attitude)
        gains = [self._params[name] for name in _ANGLE_GAINS]
        roll_share, pitch_share = (self._params[name] / DEFAULT_RATE_P for name in _RATE_GAINS)
        shares = (roll_share, pitch_share, 1.0)
        return vec3(
            shares[k]
            * RATE_GAIN_PER_S[k]
            * (feedforward_radps[k] + gains[k] * error[k] - body.rate_body_radps[k])
            for k in range(3)
        )

    def _shape(
        self, axis: str, error_rad: float, rate_radps: float, wanted_radps: float = 0.0
    ) -> float:
        """Return the next rate of a target angle that closes its error without a jump in rate.

        ``wanted_radps`` is the rate at which the wanted angle itself turns.
        """
        as_decimal = float(f"{self._params['ATC_INPUT_TC']:.7g}")  # 0.15, not 0.1500000059
        input_time_s = max(MIN_INPUT_TIME_S, as_decimal)
        max_rate_radps = math.radians(self._limit(f"ATC_RATE_{axis}_MAX"))
        wanted = clamp(error_rad / input_time_s + wanted_radps, max_rate_radps)
        return self.slew(axis, wanted, rate_radps)

    def slew(self, axis: str, wanted_radps: float, rate_radps: float) -> float:
        """Return the next rate of axis R, P or Y, within the axis' acceleration limit."""
        max_accel_radps2 = math.radians(self._limit(f"ATC_ACCEL_{axis}_MAX") / 100.0)
        return rate_radps + clamp(wanted_radps - rate_radps, max_accel_radps2 * STEP_S)

    def _limit(self, name: str) -> float:
        limit = self._params[name]
        return limit if limit > 0.0 else math.inf


class _Response:
    """Response of the firmware's vehicle to a shaped target: motor lag, and a weak yaw axis.

    The constants fit steps measured on the firmware (roll 40 deg/s: 33, 48, 53, 70-100 ms to 10,
    50, 63 and 90 %; yaw 40 deg/s: 145, 272, 307, 392 ms and a peak of 1.22).
    """

    def __init__(self) -> None:
        self.attitude = IDENTITY
        self.rate_radps: Vec3 = (0.0, 0.0, 0.0)
        self._command_radps: Vec3 = (0.0, 0.0, 0.0)
        self._yaw_accel_radps2 = 0.0

    def reset(self, body: BodyState) -> None:
        self.attitude = body.ned_from_body_wxyz
        self.rate_radps = self._command_radps = (0.0, 0.0, 0.0)
        self._yaw_accel_radps2 = 0.0

    def step(self, target: Quat, rate_radps: Vec3) -> Vec3:
        error = rotation_between(self.attitude, target)
        roll, pitch, yaw = plus(rate_radps, error, CATCH_UP_PER_S)
        before = self._command_radps
        yaw_accel = YAW_GAIN_PER_S * (yaw - before[2])
        self._yaw_accel_radps2 += (yaw_accel - self._yaw_accel_radps2) * STEP_S / YAW_LAG_S
        command = (roll, pitch, before[2] + self._yaw_accel_radps2 * STEP_S)
        self._command_radps = command
        behind = minus(command, self.rate_radps)
        self.rate_radps = plus(self.rate_radps, behind, STEP_S / MOTOR_LAG_S)
        self.attitude = integrate(self.attitude, self.rate_radps, STEP_S)
        return vec3(change / STEP_S for change in minus(command, before))


def boosted(thrust: float, body: BodyState, params: ArduPilotParams) -> float:
    """Return the collective in [0, 1] that keeps the vertical thrust in a lean of up to 84 degrees.

    ATC_ANGLE_BOOST turns it off. Formula: ArduPilot's ``get_throttle_boosted``.
    """
    if not params["ATC_ANGLE_BOOST"]:
        return thrust
    lean = cos_tilt(body.ned_from_body_wxyz)
    return min(1.0, thrust * max(0.0, min(1.0, 10.0 * lean)) / max(lean, 0.1))


def lean_for(accel_mps2: complex, body: BodyState) -> tuple[float, float]:
    """Return roll and pitch [rad] that give a hovering vehicle this horizontal acceleration."""
    level = accel_mps2 * cmath.rect(1.0, -yaw_of(body.ned_from_body_wxyz))
    return math.atan2(level.imag, GRAVITY_MPS2), -math.atan2(level.real, GRAVITY_MPS2)
