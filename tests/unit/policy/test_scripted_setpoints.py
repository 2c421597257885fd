"""Scripted programs that put out body rates, attitudes and velocities, against a small vehicle."""

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np
import pytest

from policy.contract import ActionKind
from policy.errors import PolicyError
from policy.scripted import PROGRAM_NAMES, ScriptedPolicy
from policy.scripted.programs import doublet_length_s, doublet_steps

STEP_S = 0.01
DELAY_STEPS = 4
"""From a state to the action that was computed from it."""
GRAVITY_MPS2 = 9.81
FEATURE, HISTORY = np.zeros((1, 8), np.float32), np.zeros((1, 4, 4), np.float32)
SETPOINTS: tuple[ActionKind, ...] = ("rates", "attitude", "velocity")


@dataclass
class Multirotor:
    """Lags of first order from setpoint to body rate, lean, climb and velocity; may stand."""

    action: ActionKind
    hover_thrust: float = 0.39
    now_s: float = 0.0
    north_m: float = 0.0
    east_m: float = 0.0
    up_m: float = 0.0
    north_mps: float = 0.0
    east_mps: float = 0.0
    climb_mps: float = 0.0
    roll_rad: float = 0.0
    pitch_rad: float = 0.0
    yaw_rad: float = 0.0
    rates: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    thrust: float = 0.0

    def state(self) -> np.ndarray:
        cr, sr = math.cos(self.roll_rad / 2), math.sin(self.roll_rad / 2)
        cp, sp = math.cos(self.pitch_rad / 2), math.sin(self.pitch_rad / 2)
        cy, sy = math.cos(self.yaw_rad / 2), math.sin(self.yaw_rad / 2)
        quaternion = (
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        )
        velocity = (self.north_mps, self.east_mps, -self.climb_mps)
        return np.array([[*velocity, *quaternion, *self.rates, 0.0, 0.0, -9.81]], np.float32)

    def step(self, action: np.ndarray) -> None:
        four = [float(number) for number in action]
        self.now_s += STEP_S
        if self.action == "velocity":
            self._follow_velocity(*four)
        else:
            self._follow_thrust(*four)
        self.yaw_rad += self.rates[2] * STEP_S
        self.north_m += self.north_mps * STEP_S
        self.east_m += self.east_mps * STEP_S
        self.up_m += self.climb_mps * STEP_S
        if self.up_m <= 0.0 and self.climb_mps < 0.0:
            self.up_m = self.climb_mps = 0.0

    def _follow_velocity(self, forward: float, right: float, down: float, yaw: float) -> None:
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        north, east = cos * forward - sin * right, sin * forward + cos * right
        self.north_mps += (north - self.north_mps) * STEP_S / 0.4
        self.east_mps += (east - self.east_mps) * STEP_S / 0.4
        self.climb_mps += (-down - self.climb_mps) * STEP_S / 0.4
        self.rates[2] += (yaw - self.rates[2]) * STEP_S / 0.2

    def _follow_thrust(self, thrust: float, roll: float, pitch: float, yaw: float) -> None:
        if self.action == "attitude":
            roll, pitch = 6.0 * (roll - self.roll_rad), 6.0 * (pitch - self.pitch_rad)
        for index, wanted in enumerate((roll, pitch, yaw)):
            self.rates[index] += (wanted - self.rates[index]) * STEP_S / (0.06, 0.06, 0.2)[index]
        self.roll_rad += self.rates[0] * STEP_S
        self.pitch_rad += self.rates[1] * STEP_S
        self.thrust += (thrust - self.thrust) * STEP_S / 0.05
        accel = GRAVITY_MPS2 * self.thrust / self.hover_thrust
        up = accel * math.cos(self.roll_rad) * math.cos(self.pitch_rad)
        forward, right = -accel * math.sin(self.pitch_rad), accel * math.sin(self.roll_rad)
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        self.north_mps += (cos * forward - sin * right - 0.2 * self.north_mps) * STEP_S
        self.east_mps += (sin * forward + cos * right - 0.2 * self.east_mps) * STEP_S
        if self.up_m > 0.0 or up > GRAVITY_MPS2:
            self.climb_mps += (up - GRAVITY_MPS2 - 0.2 * self.climb_mps) * STEP_S


def fly(
    program: str, duration_s: float, vehicle: Multirotor, *, starts_in_air: bool = False
) -> tuple[ScriptedPolicy, list[Multirotor]]:
    """Closed loop at 100 Hz with a delay; copies of the vehicle, one a step."""
    policy = ScriptedPolicy(
        program, lambda: vehicle.now_s, action=vehicle.action, starts_in_air=starts_in_air
    )
    on_the_way: deque[np.ndarray] = deque(maxlen=DELAY_STEPS)
    flown = []
    for _ in range(round(duration_s / STEP_S)):
        on_the_way.append(policy.predict_fast(FEATURE, vehicle.state(), HISTORY, 10)[0, 0])
        vehicle.step(on_the_way[0])
        flown.append(Multirotor(**{**vars(vehicle), "rates": list(vehicle.rates)}))
    return policy, flown


def at(flown: list[Multirotor], time_s: float) -> Multirotor:
    return flown[round(time_s / STEP_S)]


@pytest.mark.parametrize("action", SETPOINTS)
@pytest.mark.parametrize("hover_thrust", [0.33, 0.39, 0.5])
def test_takes_off_and_stays_whatever_thrust_hovers(
    action: ActionKind, hover_thrust: float
) -> None:
    _, flown = fly("hover", 25.0, Multirotor(action, hover_thrust))
    assert max(v.up_m for v in flown) < 4.2
    assert all(2.6 < v.up_m < 3.4 for v in flown[1500:])
    last = flown[-1]
    assert abs(last.up_m - 3.0) < 0.1
    assert math.hypot(last.north_mps, last.east_mps) < 0.05


@pytest.mark.parametrize("action", SETPOINTS)
def test_flies_its_square(action: ActionKind) -> None:
    policy, flown = fly("square", 30.0, Multirotor(action, yaw_rad=0.7))
    start_s = policy.program_start_s
    assert start_s is not None
    for leg, wanted in enumerate([(1.5, 0.0), (0.0, 1.5), (-1.5, 0.0), (0.0, -1.5)]):
        end = at(flown, start_s + 4.0 * (leg + 1) - 0.1)
        assert (forward(end), right(end)) == pytest.approx(wanted, abs=0.35)
    begin, back = at(flown, start_s), at(flown, start_s + 16.0)
    assert math.hypot(back.north_m - begin.north_m, back.east_m - begin.east_m) < 1.5
    assert all(2.5 < v.up_m < 3.5 for v in flown[round(start_s / STEP_S) :])


@pytest.mark.parametrize("action", SETPOINTS)
def test_circles_and_turns(action: ActionKind) -> None:
    policy, flown = fly("circle", 30.0, Multirotor(action))
    assert policy.program_start_s is not None
    early, late = (at(flown, policy.program_start_s + s) for s in (5.0, 17.0))
    assert late.yaw_rad - early.yaw_rad == pytest.approx(math.tau, rel=0.2)
    assert 1.0 < math.hypot(late.north_mps, late.east_mps) < 2.0
    assert math.hypot(late.north_m - early.north_m, late.east_m - early.east_m) < 2.0


@pytest.mark.parametrize("action", ["sticks", *SETPOINTS])
def test_what_begins_in_the_air_keeps_its_altitude(action: ActionKind) -> None:
    vehicle = Multirotor("velocity" if action == "sticks" else action, up_m=5.0, thrust=0.39)
    if action != "sticks":
        _, flown = fly("hover", 10.0, vehicle, starts_in_air=True)
        assert all(4.5 < v.up_m < 5.5 for v in flown)
    policy = ScriptedPolicy("square", lambda: vehicle.now_s, action=action, starts_in_air=True)
    policy.predict_fast(FEATURE, vehicle.state(), HISTORY, 1)
    assert policy.program_start_s == vehicle.now_s + 2.0


@pytest.mark.parametrize("action", SETPOINTS)
def test_a_drift_at_the_start_is_stopped(action: ActionKind) -> None:
    drifting = Multirotor(action, up_m=9.0, north_mps=3.0, east_mps=-2.0, thrust=0.39)
    _, flown = fly("hover", 10.0, drifting, starts_in_air=True)
    assert math.hypot(flown[-1].north_mps, flown[-1].east_mps) < 0.1


def forward(vehicle: Multirotor) -> float:
    """Speed in m/s along the nose."""
    cos, sin = math.cos(vehicle.yaw_rad), math.sin(vehicle.yaw_rad)
    return cos * vehicle.north_mps + sin * vehicle.east_mps


def right(vehicle: Multirotor) -> float:
    """Speed in m/s to the right of the nose."""
    cos, sin = math.cos(vehicle.yaw_rad), math.sin(vehicle.yaw_rad)
    return cos * vehicle.east_mps - sin * vehicle.north_mps


@pytest.mark.parametrize("action", SETPOINTS)
def test_the_doublet_pushes_every_axis_to_both_sides_and_comes_back(action: ActionKind) -> None:
    policy, flown = fly("doublet", 15.0 + doublet_length_s(action), Multirotor(action))
    start_s = policy.program_start_s
    assert start_s is not None
    for step in doublet_steps(action):
        middle_s = step.begin_s + step.half_s
        one, other = (at(flown, start_s + s - 0.02) for s in (middle_s, step.end_s))
        match step.axis:
            case "yaw":
                values = one.rates[2], other.rates[2]
            case "climb":
                values = one.climb_mps, other.climb_mps
            case "roll" if action == "velocity":
                values = right(one), right(other)
            case "roll":
                values = one.roll_rad, other.roll_rad
            case "pitch" if action == "velocity":
                values = forward(one), forward(other)
            case "pitch":
                values = -one.pitch_rad, -other.pitch_rad
        assert values[0] > 0.15 * step.share, step
        assert values[1] < -0.15 * step.share, step
        settled = at(flown, start_s + step.end_s + step.settle_s - 0.02)
        assert math.hypot(settled.north_mps, settled.east_mps) < 0.6, step
    assert all(v.up_m > 4.0 for v in flown[round(start_s / STEP_S) :])


def test_a_push_down_ends_before_the_ground() -> None:
    """The vehicle sinks at twice the speed at which it climbs."""

    class Sinking(Multirotor):
        def _follow_velocity(self, forward: float, right: float, down: float, yaw: float) -> None:
            super()._follow_velocity(forward, right, down * (2.5 if down > 0 else 1.0), yaw)

    _, flown = fly("doublet", 15.0 + doublet_length_s("velocity"), Sinking("velocity"))
    assert min(v.up_m for v in flown[1000:]) > 3.0


@pytest.mark.parametrize("action", SETPOINTS)
@pytest.mark.parametrize("program", PROGRAM_NAMES)
def test_the_contract_says_what_the_numbers_mean(program: str, action: ActionKind) -> None:
    contract = ScriptedPolicy(program, lambda: 0.0, action=action).contract
    assert (contract.action, contract.velocity_frame) == (action, "heading")
    assert contract.state_frame == "ned_frd"
    assert contract.hover_thrust == 0.39
    assert "OFFBOARD" in contract.modes
    assert ("GUIDED_NOGPS" in contract.modes) is (action != "velocity")


def test_an_unknown_kind_of_action_is_refused() -> None:
    with pytest.raises(PolicyError, match="velocity"):
        ScriptedPolicy("hover", lambda: 0.0, action="position")  # type: ignore[arg-type]
