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
from policy.stick_loop import motion_of_sticks

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
            wanted = motion_of_sticks(contract, *action)
            yaw_rad += wanted.yaw_rate_radps * step_s
            lean_mps2 = _lean_mps2(wanted.right_rad, -wanted.forward_rad, yaw_rad)
            velocity[:2] += (lean_mps2 + beyond_mps2) * step_s
            velocity[2] = -wanted.climb_mps
        else:
            return None
        path.append(path[-1] + velocity * step_s)
    return np.array(path)


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
