"""Prediction of a vehicle's motion over some tenths of a second, from the actions that it will fly.

The autopilot turns sticks and attitudes into body rates as ``stick_loop`` does; the rates follow
with a lag, and the thrust at once. What the accelerometer measures across the thrust is drag and
wind, which stay as they are. So there is nothing to identify but the gains of the contract.
"""

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple, TypeAlias

from policy.contract import Contract
from policy.motion.rotation import Quaternion, Vector, conjugate, level_heading, rotate
from policy.motion.stick_loop import (
    GRAVITY_MPS2,
    LAG_S,
    StickLoop,
    StickMotion,
    motion_of_sticks,
    turned,
)

Four: TypeAlias = tuple[float, float, float, float]
AUTOPILOT_TILT_GAIN_PER_S, AUTOPILOT_LAG_S = 6.0, 0.1
"""The autopilot's own attitude loop, for sticks and attitudes: fits ArduPilot and PX4."""
VELOCITY_LAG_S = 0.5
"""Lag from velocity command to velocity."""
MOST_LEAN_DEG = 80.0


class VehicleMotion(NamedTuple):
    """Motion of a vehicle; world NED, body FRD."""

    ned_from_body_wxyz: Quaternion
    rate_body_radps: Vector
    velocity_ned_mps: Vector
    specific_force_body_mps2: Vector


class ForwardMotion:
    """Predicts the motion of a vehicle that flies the actions of one contract."""

    def __init__(self, contract: Contract) -> None:
        self._contract = contract
        self._lag_s = LAG_S if contract.action == "rates" else AUTOPILOT_LAG_S
        lean_deg = contract.full_lean_deg if contract.action == "sticks" else MOST_LEAN_DEG
        level = replace(contract, state_frame="ned_frd", full_lean_deg=lean_deg)
        self._loop = StickLoop(level, AUTOPILOT_TILT_GAIN_PER_S)

    def after(self, start: VehicleMotion, actions: Iterable[Four], dt_s: float) -> VehicleMotion:
        """Return the motion after flying each action for ``dt_s``.

        Actions are of the contract's kind, in NED and FRD axes even for a contract in ENU.
        """
        attitude, rate, velocity, _ = start
        x, y, _ = start.specific_force_body_mps2
        drag_ned: Vector = rotate(attitude, (x, y, 0.0))
        thrust_mps2 = -start.specific_force_body_mps2[2]
        share = 1.0 - math.exp(-dt_s / self._lag_s)
        is_velocity = self._contract.action == "velocity"
        for action in actions:
            if is_velocity:
                rate = (0.0, 0.0, action[3])
                velocity = self._towards(velocity, action, attitude, dt_s)
                attitude = turned(attitude, rate, dt_s)
                continue
            thrust_mps2, wanted = self._demand(action, attitude, -velocity[2])
            p, q, r = (now + share * (to - now) for now, to in zip(rate, wanted, strict=True))
            rate = (p, q, r)
            attitude = turned(attitude, rate, dt_s)
            thrust_ned: Vector = rotate(attitude, (0.0, 0.0, -thrust_mps2))
            vx, vy, vz = (
                v + dt_s * (thrust + drag)
                for v, thrust, drag in zip(velocity, thrust_ned, drag_ned, strict=True)
            )
            velocity = (vx, vy, vz + dt_s * GRAVITY_MPS2)
        fx, fy, fz = rotate(conjugate(attitude), drag_ned)
        force = start.specific_force_body_mps2 if is_velocity else (fx, fy, fz - thrust_mps2)
        return VehicleMotion(attitude, rate, velocity, force)

    def _demand(self, action: Four, attitude: Quaternion, climb_mps: float) -> tuple[float, Vector]:
        """Return the specific force along the thrust [m/s^2] and the body rates of an action."""
        contract, (first, second, third, fourth) = self._contract, action
        force_mps2 = first / contract.hover_thrust * GRAVITY_MPS2
        match contract.action:
            case "rates":
                return force_mps2, (second, third, fourth)
            case "attitude":
                wanted = StickMotion(0.0, fourth, forward_rad=-third, right_rad=second)
                return force_mps2, self._loop.demand(wanted, attitude, climb_mps)[2]
        wanted = motion_of_sticks(contract, *action)
        up_mps2, cos_tilt, rate = self._loop.demand(wanted, attitude, climb_mps)
        return up_mps2 / cos_tilt, rate

    def _towards(self, velocity: Vector, action: Four, attitude: Quaternion, dt_s: float) -> Vector:
        x, y, down, _ = action
        if self._contract.velocity_frame == "heading":
            cosine, sine = level_heading(attitude)
            x, y = cosine * x - sine * y, sine * x + cosine * y
        share = 1.0 - math.exp(-dt_s / VELOCITY_LAG_S)
        vx, vy, vz = (v + share * (to - v) for v, to in zip(velocity, (x, y, down), strict=True))
        return (vx, vy, vz)
