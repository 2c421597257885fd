"""Control laws of all modes: from mode, sticks, setpoint and state to motor commands."""

import cmath
import math
from typing import TypeAlias

from sitl.px4 import sticks as pilot
from sitl.px4.control import (
    HOVER_THRUST,
    SIH_QUAD,
    STEP_S,
    STILL,
    Horizontal,
    RateController,
    attitude_for,
)
from sitl.px4.modes import Px4Mode
from sitl.px4.params import Px4Params
from sitl.px4.sticks import Px4Sticks
from sitl.vehicle.dynamics import BodyState, HeightController, mix, thrust_for
from sitl.vehicle.firmware import AttitudeSetpoint, VelocitySetpoint
from sitl.vehicle.rotation import (
    IDENTITY,
    Quat,
    Vec3,
    cos_tilt,
    from_euler,
    horizontal,
    length,
    yaw_of,
)

IDLE = (0.05, 0.05, 0.05, 0.05)  # armed on the ground
STILL_YAW_RADPS = 0.01  # a slower yaw command holds the heading
TAKEOFF_CLIMB_MPS = 0.3  # a faster climb demand lifts a landed vehicle off
ARRIVED_M = 1.0


Setpoint: TypeAlias = AttitudeSetpoint | VelocitySetpoint
"""Setpoint of a companion computer in OFFBOARD."""


class Px4Control:
    """Control laws of all modes, with their shared controllers."""

    def __init__(self, params: Px4Params) -> None:
        self._params = params
        self._rates = RateController(params)
        self._horizontal = Horizontal(params)
        self._height = HeightController(STEP_S)
        self._yaw_rate_radps = 0.0
        self._yaw_hold_rad: float | None = None
        self._accel_mps2 = STILL  # last demanded, north and east
        self._target_m: complex | None = None
        self._home_reached = False
        self._returns_to_m: float | None = None
        self.takeoff_to_m = 0.0  # height at which AUTO.TAKEOFF ends
        self.most_climb_mps = math.inf
        """Limit of the climb rate while the vehicle leaves the ground."""
        self.thrust = 0.0  # commanded collective, 0..1
        self.attitude: Quat = IDENTITY  # demanded attitude, as ATTITUDE_TARGET reports it
        self.velocity_ned_mps: Vec3 = (0.0, 0.0, 0.0)
        """Demanded velocity, as POSITION_TARGET_LOCAL_NED reports it."""
        self.yaw_rate_radps = 0.0  # demanded yaw rate, reported by the same message

    @property
    def rates_radps(self) -> Vec3:
        return self._rates.rates_radps

    def reset(self, body: BodyState) -> None:
        self._rates.reset()
        self._horizontal.reset(body, self._accel_mps2)
        self._height.reset(body)
        self._yaw_rate_radps = 0.0
        self._yaw_hold_rad = None
        self._home_reached = False
        self._returns_to_m = None
        self._target_m = None
        self.attitude = body.ned_from_body_wxyz
        self.velocity_ned_mps = (0.0, 0.0, 0.0)
        self.thrust = 0.0

    def idle(self, body: BodyState) -> tuple[float, ...]:
        self._accel_mps2 = STILL
        self.reset(body)
        return IDLE

    def wants_takeoff(
        self, mode: Px4Mode, sticks: Px4Sticks, setpoint: Setpoint | None, body: BodyState
    ) -> bool:
        if mode is Px4Mode.AUTO_TAKEOFF:
            return -body.position_ned_m[2] < self.takeoff_to_m
        if mode.manual_throttle:
            return pilot.manual_thrust(sticks, self._params, HOVER_THRUST) > 0.9 * HOVER_THRUST
        if mode.piloted:
            return pilot.climb_mps(sticks, self._params) > TAKEOFF_CLIMB_MPS
        if mode is not Px4Mode.OFFBOARD or setpoint is None:
            return False
        if isinstance(setpoint, VelocitySetpoint):
            return self._offboard_climb_mps(setpoint) > TAKEOFF_CLIMB_MPS
        return setpoint.thrust > 0.9 * HOVER_THRUST

    def fly(
        self,
        mode: Px4Mode,
        sticks: Px4Sticks,
        setpoint: Setpoint | None,
        body: BodyState,
        *,
        has_position: bool,
    ) -> tuple[float, ...]:
        if mode is Px4Mode.OFFBOARD and setpoint is not None:
            return self._fly_offboard(setpoint, body)
        yaw_rate = self._stick_yaw(sticks if mode.piloted else Px4Sticks(), body)
        yaw = self._heading_rad(body)
        if mode.manual_throttle:
            roll, pitch = pilot.lean_rad(sticks, self._params)
            thrust = pilot.manual_thrust(sticks, self._params, HOVER_THRUST)
            return self._lean_to(from_euler(roll, pitch, yaw), yaw_rate, thrust, body)
        if mode is Px4Mode.ALTCTL:
            accel = pilot.lean_accel_mps2(sticks, self._params) * cmath.rect(1.0, yaw)
        elif not has_position:
            accel = STILL
        elif mode is Px4Mode.POSCTL:
            wanted = pilot.speed_mps(sticks, self._params) * cmath.rect(1.0, yaw)
            accel = self._horizontal.steer(wanted, body)
        else:
            accel = self._horizontal.fly_to(self._destination(mode, body), body)
        self._accel_mps2 = accel
        thrust = self._climb(self._climb_mps(mode, sticks, body), body)
        return self._lean_to(attitude_for(accel, yaw), yaw_rate, thrust, body)

    def _fly_offboard(self, setpoint: Setpoint, body: BodyState) -> tuple[float, ...]:
        if isinstance(setpoint, AttitudeSetpoint):
            target, rates, thrust = setpoint
            if target is not None:
                return self._lean_to(target, rates[2], thrust, body)
            self.attitude, self.thrust = body.ned_from_body_wxyz, thrust
            return mix(thrust, self._rates.rates(body, rates), SIH_QUAD)
        wanted = horizontal(setpoint.velocity_ned_mps)
        accel = self._accel_mps2 = self._horizontal.track(wanted, body)
        yaw_rate = self._hold_yaw(setpoint.yaw_rate_radps, body)
        yaw = self._heading_rad(body)
        thrust = self._climb(self._offboard_climb_mps(setpoint), body)
        return self._lean_to(attitude_for(accel, yaw), yaw_rate, thrust, body)

    def _offboard_climb_mps(self, setpoint: VelocitySetpoint) -> float:
        climb = -setpoint.velocity_ned_mps[2]
        return max(-self._params["MPC_Z_VEL_MAX_DN"], min(self._params["MPC_Z_VEL_MAX_UP"], climb))

    def _lean_to(
        self, target: Quat, yaw_rate_radps: float, thrust: float, body: BodyState
    ) -> tuple[float, ...]:
        self.attitude, self.thrust, self.yaw_rate_radps = target, thrust, yaw_rate_radps
        return mix(thrust, self._rates.attitude(body, target, yaw_rate_radps), SIH_QUAD)

    def _stick_yaw(self, sticks: Px4Sticks, body: BodyState) -> float:
        wanted = pilot.yaw_rate_radps(sticks, self._params)
        lag_s = max(STEP_S, self._params["MPC_MAN_Y_TAU"])
        self._yaw_rate_radps += (wanted - self._yaw_rate_radps) * STEP_S / lag_s
        return self._hold_yaw(self._yaw_rate_radps, body)

    def _heading_rad(self, body: BodyState) -> float:
        held_rad = self._yaw_hold_rad
        return yaw_of(body.ned_from_body_wxyz) if held_rad is None else held_rad

    def _hold_yaw(self, yaw_rate_radps: float, body: BodyState) -> float:
        """Return the yaw rate; near zero, return 0 and hold the present heading."""
        if abs(yaw_rate_radps) > STILL_YAW_RADPS:
            self._yaw_hold_rad = None
            return yaw_rate_radps
        self._yaw_hold_rad = self._heading_rad(body)
        return 0.0

    def _climb(self, climb_mps: float, body: BodyState) -> float:
        climb_mps = min(climb_mps, self.most_climb_mps)
        max_accel_mps2 = self._params["MPC_ACC_UP_MAX" if climb_mps > 0 else "MPC_ACC_DOWN_MAX"]
        accel = self._height.update(body, climb_mps, max_accel_mps2)
        thrust = thrust_for(accel, cos_tilt(body.ned_from_body_wxyz), HOVER_THRUST)
        speed = self._horizontal.speed_mps
        self.velocity_ned_mps = (speed.real, speed.imag, -climb_mps)
        return max(self._params["MPC_THR_MIN"], min(self._params["MPC_THR_MAX"], thrust))

    def _climb_mps(self, mode: Px4Mode, sticks: Px4Sticks, body: BodyState) -> float:
        """Return the climb rate demanded by mode and sticks; near the ground it is slower."""
        params, height = self._params, -body.position_ned_m[2]
        low, high = params["MPC_LAND_ALT2"], params["MPC_LAND_ALT1"]
        share = max(0.0, min(1.0, (height - low) / max(0.1, high - low)))
        slow, fast = params["MPC_LAND_SPEED"], params["MPC_Z_V_AUTO_DN"]
        if mode.piloted:
            up = params["MPC_TKO_SPEED"]
            up += share * (params["MPC_Z_VEL_MAX_UP"] - up)
            down = slow + share * (params["MPC_Z_VEL_MAX_DN"] - slow)
            return max(-down, min(up, pilot.climb_mps(sticks, params)))
        if mode is Px4Mode.AUTO_TAKEOFF:
            return max(0.0, min(params["MPC_TKO_SPEED"], 1.5 * (self.takeoff_to_m + 0.1 - height)))
        if mode is Px4Mode.AUTO_RTL and not self._home_reached:
            up = self._return_height_m(body) - height
            return max(-params["MPC_Z_V_AUTO_DN"], min(params["MPC_Z_V_AUTO_UP"], up))
        if mode not in (Px4Mode.AUTO_RTL, Px4Mode.AUTO_LAND):
            return 0.0
        return -(slow + share * (fast - slow))

    def _destination(self, mode: Px4Mode, body: BodyState) -> complex | None:
        """Return the target of an AUTO mode; None: stay at the resting position."""
        if mode is not Px4Mode.AUTO_RTL or self._home_reached:
            return self._target_m
        if -body.position_ned_m[2] > self._return_height_m(body) - ARRIVED_M:
            self._target_m = STILL  # home
            self._home_reached = length(horizontal(body.position_ned_m)) < ARRIVED_M
        return self._target_m

    def _return_height_m(self, body: BodyState) -> float:
        """Return RTL_RETURN_ALT, or near home the height at which RTL began."""
        if self._returns_to_m is None:
            is_near = length(horizontal(body.position_ned_m)) < self._params["RTL_MIN_DIST"]
            return_m = self._params["RTL_RETURN_ALT"]
            self._returns_to_m = -body.position_ned_m[2] if is_near else return_m
        return self._returns_to_m
