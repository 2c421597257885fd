"""Chunks of the policy as the viewer shows them: against what was sent, and as a path."""

import math

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from mavbridge.core.clock import NS_PER_S
from mavbridge.core.records import Position, Solve
from mavbridge.core.rotation import heading_rad, roll_pitch_rad
from mavbridge.core.vehicle import Action, Sticks, Velocity
from mavbridge.observe.viewer import layout
from mavbridge.observe.viewer.columns import Columns
from mavbridge.observe.viewer.layout import ViewedFlight
from mavbridge.observe.viewer.motion import Motion
from policy.contract import Contract

GRAVITY_MPS2 = 9.81
_STEEPEST_RAD = math.radians(80)


class PlanView:
    """Shows one chunk out of many: the next one that finds a lane free."""

    def __init__(self, columns: Columns, flight: ViewedFlight) -> None:
        self._columns = columns
        self._contract = flight.contract
        self._to_ned = flight.to_ned
        self._lanes = layout.plan_plots(flight.contract.action)
        self._next_ns = 0
        self._shown = 0

    def show(self, solve: Solve, position: Position | None) -> None:
        """Show this chunk, if it is due; ``position`` is the vehicle's, in NED, if known."""
        if self._to_ned is None or solve.first_ns < self._next_ns:
            return
        actions = self._to_ned(solve.actions[0])
        step_ns = solve.step_ns
        self._next_ns = solve.first_ns + (len(actions) + 1) * step_ns // layout.PLAN_LANES + 1
        lane = self._lanes[self._shown % len(self._lanes)]
        self._shown += 1
        stamps_ns = [solve.first_ns + number * step_ns for number in range(len(actions) + 1)]
        for axis, plot in enumerate(lane):
            values = [*(action[axis] for action in actions), math.nan]  # the gap ends this line
            self._columns.plot(plot, stamps_ns, [(value,) for value in values])
        path = planned_path(solve, actions, self._contract)
        if position is not None and path is not None:
            strips = rr.LineStrips3D.columns(strips=[path + np.array(position)])
            self._columns.send(layout.PLANNED_PATH, [solve.computed_ns], strips)


def planned_path(
    solve: Solve, actions: tuple[Action, ...], contract: Contract
) -> NDArray[np.float64] | None:
    """Path [1 + horizon, 3] from the vehicle, in NED metres, if it flies as the chunk says.

    Velocities are followed at once. Sticks are leans, climb and yaw rate by the contract's gains,
    also at once; what the vehicle accelerates beyond its present lean, such as drag, stays as it
    is. None for actions of other kinds.
    """
    motion = Motion.of(solve.state, contract.state_frame)
    yaw_rad, step_s = heading_rad(motion.ned_from_body_wxyz), solve.step_ns / NS_PER_S
    lean_rad = roll_pitch_rad(motion.ned_from_body_wxyz)
    beyond_mps2 = motion.horizontal_mps2 - _lean_mps2(*lean_rad, yaw_rad)
    velocity = np.array(motion.velocity_ned_mps)
    path = [np.zeros(3)]
    for action in actions:
        if isinstance(action, Velocity):
            velocity = np.array(action[:3])
            if contract.velocity_frame != "world":
                velocity[:2] = _turned(velocity[0], velocity[1], yaw_rad)
            yaw_rad += action.yaw_rate_radps * step_s
        elif isinstance(action, Sticks):
            roll_rad, pitch_rad, climb_mps, yaw_rate_radps = _meaning(action, contract)
            yaw_rad += yaw_rate_radps * step_s
            velocity[:2] += (_lean_mps2(roll_rad, pitch_rad, yaw_rad) + beyond_mps2) * step_s
            velocity[2] = -climb_mps
        else:
            return None
        path.append(path[-1] + velocity * step_s)
    return np.array(path)


def _meaning(sticks: Sticks, contract: Contract) -> tuple[float, float, float, float]:
    """Roll, pitch (+ nose up), climb in m/s and yaw rate that these sticks ask for."""
    lean_rad = math.radians(contract.full_lean_deg)
    climb = _beyond(sticks.throttle, contract.throttle_dead_zone)
    return (
        _beyond(sticks.roll, contract.lean_dead_zone) * lean_rad,
        -_beyond(sticks.pitch, contract.lean_dead_zone) * lean_rad,
        climb * (contract.full_climb_mps if climb > 0 else contract.full_descent_mps),
        math.radians(_beyond(sticks.yaw, contract.yaw_dead_zone) * contract.full_yaw_rate_degps),
    )


def _beyond(stick: float, dead_zone: float) -> float:
    """Share of the travel beyond the dead zone, with the stick's sign."""
    return math.copysign(max(0.0, min(abs(stick), 1.0) - dead_zone) / (1 - dead_zone), stick)


def _lean_mps2(roll_rad: float, pitch_rad: float, yaw_rad: float) -> NDArray[np.float64]:
    """Acceleration towards north and east of a vehicle that leans so and keeps its height."""
    roll_rad, pitch_rad = (
        max(-_STEEPEST_RAD, min(lean, _STEEPEST_RAD)) for lean in (roll_rad, pitch_rad)
    )
    forward, right = -math.tan(pitch_rad), math.tan(roll_rad) / math.cos(pitch_rad)
    return GRAVITY_MPS2 * _turned(forward, right, yaw_rad)


def _turned(forward: float, right: float, yaw_rad: float) -> NDArray[np.float64]:
    """A level vector in the axes of the nose -> north and east."""
    sine, cosine = math.sin(yaw_rad), math.cos(yaw_rad)
    return np.array([forward * cosine - right * sine, forward * sine + right * cosine])
