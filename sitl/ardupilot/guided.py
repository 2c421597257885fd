"""GUIDED and GUIDED_NOGPS: setpoints of a companion computer instead of the pilot's sticks.

Accepted messages, the effect of invalid ones, the timeout and the response times are those measured
on the firmware.
"""

import math
from enum import Enum, auto

from sitl.ardupilot.control import STEP_S, AttitudeController, lean_for
from sitl.ardupilot.params import ArduPilotParams
from sitl.clock import NS_PER_MS, NS_PER_S
from sitl.vehicle.dynamics import BodyState, HeightController, clamp_axes, shorten, thrust_for
from sitl.vehicle.firmware import AttitudeSetpoint, VelocitySetpoint
from sitl.vehicle.rotation import Vec3, from_euler, horizontal, integrate, length, to_euler

OPTION_THRUST = 8
"""Bit of GUID_OPTIONS: SET_ATTITUDE_TARGET.thrust is a collective instead of a climb rate."""
ARMING_DELAY_NS = 2 * NS_PER_S
SPOOL_UP_NS = 500 * NS_PER_MS
CLIMB_WINDUP_NS = 500 * NS_PER_MS
"""Added to SPOOL_UP_NS if the height controller does the lift-off. On the firmware a takeoff to 8 m
passed 2 m after 3.0 s."""
TAKEOFF_DECEL_MPS2 = 0.7
TAKEOFF_GAIN_PER_S = 1.0
ACCEL_MPS2 = 2.5  # WPNAV_ACCEL
JERK_MPS3 = 5.0  # PSC_JERK_XY
SPEED_GAIN_PER_S = 1.8  # towards the target's speed; on the firmware 2 m/s took 1.34 s to 90 %
VELOCITY_GAIN_PER_S = 2.0
POSITION_GAIN_PER_S = 1.0
MAX_POSITION_ERROR_M = 2.0
MAX_LEAN_ACCEL_MPS2 = 5.0
MIN_CLIMB_ACCEL_MPS2 = 0.5
STOP = VelocitySetpoint((0.0, 0.0, 0.0), 0.0)


class Submode(Enum):
    """Kind of setpoint that GUIDED follows; GUIDED_NOGPS supports ATTITUDE only."""

    VELOCITY = auto()
    ATTITUDE = auto()
    TAKEOFF = auto()


class GuidedControl:
    """Control law of both modes, on the attitude and height controllers shared by all modes."""

    def __init__(
        self, params: ArduPilotParams, attitude: AttitudeController, height: HeightController
    ) -> None:
        self._params = params
        self._attitude = attitude
        self._height = height
        self.submode = Submode.ATTITUDE
        self.velocity = STOP  # followed in Submode.VELOCITY
        self._takeoff_height_m = 0.0
        self._setpoint: AttitudeSetpoint | None = None
        self._has_thrust = False
        self._received_ns = 0
        self._spooling_since_ns: int | None = None
        self._track = _Track()
        self._yaw = self._yaw_rate_radps = 0.0

    def enter(self, body: BodyState, *, with_position: bool) -> None:
        """Clear all setpoints: GUIDED then brakes, GUIDED_NOGPS levels and holds its height."""
        self._setpoint = None
        self._has_thrust = False
        self.submode = Submode.ATTITUDE
        if with_position:
            self.brake(body)

    def brake(self, body: BodyState) -> None:
        """Stop and hold. An invalid setpoint in GUIDED does the same."""
        self._start(Submode.VELOCITY, body)

    def follow_attitude(self, setpoint: AttitudeSetpoint, body: BodyState, now_ns: int) -> None:
        has_thrust = bool(self._params.integer("GUID_OPTIONS") & OPTION_THRUST)
        if self._has_thrust and not has_thrust:
            self._height.reset(body)
        self._has_thrust = has_thrust
        self._setpoint = setpoint
        self._received_ns = now_ns
        self.submode = Submode.ATTITUDE

    def follow_velocity(self, setpoint: VelocitySetpoint, body: BodyState, now_ns: int) -> None:
        self._start(Submode.VELOCITY, body)
        self.velocity = setpoint
        self._received_ns = now_ns

    def take_off(self, height_m: float, body: BodyState) -> None:
        """Climb to this height above home; any setpoint ends it."""
        self._start(Submode.TAKEOFF, body)
        self._takeoff_height_m = height_m

    def is_taking_off(self, body: BodyState) -> bool:
        """True while `take_off` has over a tenth of its height left or the climb is still fast.

        Formula: ArduCopter's ``auto_takeoff``; fast is at least half of WPNAV_SPEED_UP.
        """
        if self.submode is not Submode.TAKEOFF:
            return False
        is_up = -body.position_ned_m[2] >= 0.9 * self._takeoff_height_m
        return not is_up or -body.velocity_ned_mps[2] >= self._params["WPNAV_SPEED_UP"] / 200.0

    def lifts_off(self, now_ns: int, armed_ns: int) -> bool:
        """True once a landed vehicle has spun its motors up for a takeoff.

        A thrust or climb rate above zero lifts it off, as does `take_off`; a velocity never does.
        """
        wanted = self.submode is Submode.TAKEOFF
        by_thrust = self.submode is Submode.ATTITUDE and self._has_thrust
        if self.submode is Submode.ATTITUDE and self._setpoint and not self._is_over(now_ns):
            wanted = (self._thrust() if by_thrust else self._climb_mps()) > 0.0
        if not wanted or now_ns - armed_ns < ARMING_DELAY_NS:
            self._spooling_since_ns = None
        elif self._spooling_since_ns is None:
            self._spooling_since_ns = now_ns
        else:
            windup_ns = 0 if by_thrust else CLIMB_WINDUP_NS
            return now_ns - self._spooling_since_ns >= SPOOL_UP_NS + windup_ns
        return False

    def fly(self, body: BodyState, now_ns: int, *, has_position: bool) -> tuple[Vec3, float]:
        """Return body angular acceleration [rad/s^2] and thrust (0..1, of a level vehicle)."""
        if self.submode is Submode.ATTITUDE:
            return self._fly_attitude(body, now_ns)
        return self._fly_velocity(body, now_ns, has_position=has_position)

    def _fly_attitude(self, body: BodyState, now_ns: int) -> tuple[Vec3, float]:
        setpoint = self._setpoint
        if setpoint is None or self._is_over(now_ns):
            if self._has_thrust:
                self._height.reset(body)
                self._has_thrust = False
            yaw = to_euler(self._attitude.target[0])[2]
            level = from_euler(0.0, 0.0, yaw)
            turn = self._attitude.approach(body, level, (0.0, 0.0, 0.0))
            return turn, self.climb(body, 0.0)
        attitude, rate = setpoint.ned_from_body_wxyz, setpoint.rate_body_radps
        if attitude is None:
            turn = self._attitude.turn(body, rate)
        else:
            turn = self._attitude.approach(body, attitude, rate)
            self._setpoint = setpoint._replace(ned_from_body_wxyz=integrate(attitude, rate, STEP_S))
        if self._has_thrust:
            return turn, self._thrust()
        return turn, self.climb(body, self._climb_mps())

    def _fly_velocity(
        self, body: BodyState, now_ns: int, *, has_position: bool
    ) -> tuple[Vec3, float]:
        (north, east, down), yaw_rate = self.velocity
        if self.submode is Submode.TAKEOFF:
            to_go_m = self._takeoff_height_m + body.position_ned_m[2]
            braking = math.sqrt(2.0 * TAKEOFF_DECEL_MPS2 * max(0.0, to_go_m))
            up = self._params["WPNAV_SPEED_UP"] / 100.0
            down = -min(up, braking, TAKEOFF_GAIN_PER_S * to_go_m)
        elif self._is_over(now_ns):
            north = east = down = yaw_rate = 0.0
            self.velocity = STOP
        roll = pitch = 0.0
        if has_position:
            accel = self._track.step(complex(north, east), body)
            roll, pitch = lean_for(accel, body)
        self._yaw_rate_radps = self._attitude.slew("Y", yaw_rate, self._yaw_rate_radps)
        self._yaw += self._yaw_rate_radps * STEP_S
        attitude = from_euler(roll, pitch, self._yaw)
        turn = self._attitude.approach(body, attitude, (0.0, 0.0, self._yaw_rate_radps))
        return turn, self.climb(body, -down)

    def _start(self, submode: Submode, body: BodyState) -> None:
        """Set the velocity to zero, and reset the controllers if the submode changes."""
        self.velocity = STOP
        if self.submode is not submode:
            self.submode = submode
            self._height.reset(body)
            self._track.reset(body)
            self._yaw_rate_radps = 0.0
            _, _, self._yaw = to_euler(self._attitude.target[0])

    def _is_over(self, now_ns: int) -> bool:
        timeout_s = max(0.1, self._params["GUID_TIMEOUT"])
        return now_ns - self._received_ns > timeout_s * NS_PER_S

    def _thrust(self) -> float:
        return max(0.0, min(1.0, self._setpoint.thrust)) if self._setpoint else 0.0

    def _climb_mps(self) -> float:
        """Return the climb rate of a thrust: 0 is WPNAV_SPEED_DN, 0.5 zero, 1 WPNAV_SPEED_UP."""
        above_half = 2.0 * self._thrust() - 1.0
        limit = "WPNAV_SPEED_UP" if above_half > 0.0 else "WPNAV_SPEED_DN"
        return above_half * self._params[limit] / 100.0

    def climb(self, body: BodyState, climb_mps: float, limit: str = "WPNAV_ACCEL_Z") -> float:
        """Return the thrust (0..1, of a level vehicle) for a climb rate; ``limit`` names the
        parameter that limits its change."""
        limit_mps2 = max(MIN_CLIMB_ACCEL_MPS2, self._params[limit] / 100.0)
        accel_mps2 = self._height.update(body, climb_mps, limit_mps2)
        return thrust_for(accel_mps2, 1.0, self._params["MOT_THST_HOVER"])


class _Track:
    """Horizontal target whose velocity changes without jumps, and the controller towards it."""

    def __init__(self) -> None:
        self._position_m = self._velocity_mps = self._accel_mps2 = 0j

    def reset(self, body: BodyState) -> None:
        self._position_m = horizontal(body.position_ned_m)
        self._velocity_mps = horizontal(body.velocity_ned_mps)
        self._accel_mps2 = 0j

    def step(self, wanted_mps: complex, body: BodyState) -> complex:
        """Return the vehicle's acceleration [m/s^2]."""
        error = wanted_mps - self._velocity_mps
        scale = min(SPEED_GAIN_PER_S, ACCEL_MPS2 / max(1e-6, length(error)))
        self._accel_mps2 += clamp_axes(scale * error - self._accel_mps2, JERK_MPS3 * STEP_S)
        self._velocity_mps += self._accel_mps2 * STEP_S
        here_m = horizontal(body.position_ned_m)
        ahead_m = self._position_m + self._velocity_mps * STEP_S - here_m
        self._position_m = here_m + clamp_axes(ahead_m, MAX_POSITION_ERROR_M)
        speed_error = (
            self._velocity_mps
            + POSITION_GAIN_PER_S * (self._position_m - here_m)
            - horizontal(body.velocity_ned_mps)
        )
        accel = self._accel_mps2 + VELOCITY_GAIN_PER_S * speed_error
        return shorten(accel, MAX_LEAN_ACCEL_MPS2)
