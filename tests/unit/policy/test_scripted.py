"""Scripted programs in every kind of action, flown in closed loop against a small vehicle."""

import copy
import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from policy.contract import ActionKind, Contract
from policy.motion.controllers import (
    PROGRAM_NAMES,
    Measured,
    doublet_length_s,
    doublet_steps,
    measure,
)
from policy.motion.forward_motion import ForwardMotion, VehicleMotion
from policy.motion.scripted import ScriptedPolicy
from policy.motion.stick_loop import GRAVITY_MPS2

STEP_S = 0.01
DELAY_STEPS = 4
"""From a state to the action that was computed from it."""
FEATURE, HISTORY = np.zeros((1, 8), np.float32), np.zeros((1, 4, 4), np.float32)
KINDS: tuple[ActionKind, ...] = ("sticks", "rates", "attitude", "velocity")
AT_REST = VehicleMotion((1.0, 0.0, 0.0, 0.0), (0.0,) * 3, (0.0,) * 3, (0.0, 0.0, -GRAVITY_MPS2))


@dataclass
class Vehicle:
    """Follows each action as ``ForwardMotion`` predicts it; may stand on the ground at first."""

    action: ActionKind
    terms: dict[str, float] = field(default_factory=dict)
    """Of its contract, where they differ from the policy's."""
    leaves_ground_at_s: float = 0.0
    sinks_faster: float = 1.0
    motion: VehicleMotion = AT_REST
    now_s: float = 0.0
    up_m: float = 0.0

    def __post_init__(self) -> None:
        contract = Contract(action=self.action, velocity_frame="heading", **self.terms)  # type: ignore[arg-type]
        self.model = ForwardMotion(contract)

    def state(self) -> np.ndarray:
        attitude, rate, velocity, force = self.motion
        return np.array([[*velocity, *attitude, *rate, *force]], np.float32)

    def step(self, action: np.ndarray) -> None:
        self.now_s += STEP_S
        if self.now_s < self.leaves_ground_at_s:
            return
        first, second, third, fourth = action.tolist()
        if self.action == "velocity" and third > 0:
            third *= self.sinks_faster
        self.motion = self.model.after(self.motion, [(first, second, third, fourth)], STEP_S)
        self.up_m -= self.motion.velocity_ned_mps[2] * STEP_S

    @property
    def measured(self) -> Measured:
        return measure(self.state()[0])

    @property
    def speed_mps(self) -> float:
        return math.hypot(*self.motion.velocity_ned_mps[:2])


def fly(
    program: str, duration_s: float, vehicle: Vehicle, *, starts_in_air: bool = False
) -> tuple[ScriptedPolicy, list[Vehicle]]:
    """Closed loop at 100 Hz with a delay; copies of the vehicle, one a step."""
    policy = ScriptedPolicy(
        program, lambda: vehicle.now_s, action=vehicle.action, starts_in_air=starts_in_air
    )
    return policy, fly_on(policy, duration_s, vehicle)


def fly_on(policy: ScriptedPolicy, duration_s: float, vehicle: Vehicle) -> list[Vehicle]:
    on_the_way: deque[np.ndarray] = deque(maxlen=DELAY_STEPS)
    flown = []
    for _ in range(round(duration_s / STEP_S)):
        on_the_way.append(policy.predict_fast(FEATURE, vehicle.state(), HISTORY, 10)[0, 0])
        vehicle.step(on_the_way[0])
        flown.append(copy.copy(vehicle))
    return flown


def drifting(north_mps: float, east_mps: float, climb_mps: float = 0.0) -> VehicleMotion:
    return AT_REST._replace(velocity_ned_mps=(north_mps, east_mps, -climb_mps))


@pytest.mark.parametrize(
    "vehicle",
    [
        Vehicle("sticks", {"throttle_dead_zone": 0.0}),
        *(Vehicle(kind, {"hover_thrust": at}) for kind in KINDS[1:3] for at in (0.33, 0.5)),
        Vehicle("velocity"),
        Vehicle("sticks", leaves_ground_at_s=3.0),
    ],
)
def test_takes_off_to_three_metres_and_stays(vehicle: Vehicle) -> None:
    flown = fly("hover", vehicle.leaves_ground_at_s + 25.0, vehicle)[1]
    assert max(v.up_m for v in flown) < 4.2
    assert all(2.5 < v.up_m < 3.5 for v in flown[1500:])
    assert flown[-1].speed_mps < 0.05


@pytest.mark.parametrize("kind", KINDS)
def test_begun_in_the_air_it_stops_a_drift_and_keeps_its_altitude(kind: ActionKind) -> None:
    vehicle = Vehicle(kind, up_m=9.0, motion=drifting(3.0, -2.0))
    policy, flown = fly("hover", 10.0, vehicle, starts_in_air=True)
    assert policy.program_start_s == pytest.approx(2.0, abs=0.02)
    assert flown[-1].speed_mps < 0.25
    assert all(8.0 < v.up_m < 10.0 for v in flown)


def test_reset_begins_again_from_the_altitude_of_now() -> None:
    vehicle = Vehicle("sticks")
    policy, _ = fly("square", 10.0, vehicle)
    assert vehicle.up_m == pytest.approx(3.0, abs=0.5)
    policy.reset()
    fly_on(policy, 4.0, vehicle)
    assert vehicle.up_m == pytest.approx(6.0, abs=0.7)
    assert vehicle.speed_mps < 0.25


@pytest.mark.parametrize("kind", KINDS[1:])
def test_the_doublet_pushes_every_axis_to_both_sides_and_comes_back(kind: ActionKind) -> None:
    policy, flown = fly("doublet", 15.0 + doublet_length_s(kind), Vehicle(kind))
    start_s = policy.program_start_s
    for step in doublet_steps(kind):
        middle_s = step.begin_s + step.half_s
        ends_s = (middle_s, step.end_s, step.end_s + step.settle_s)
        one, other, settled = (flown[round((start_s + s - 0.02) / STEP_S)] for s in ends_s)
        moved = {
            "yaw": lambda m: m.yaw_rate_radps,
            "climb": lambda m: m.climb_mps,
            "roll": lambda m: m.right_mps if kind == "velocity" else m.roll_rad,
            "pitch": lambda m: m.forward_mps if kind == "velocity" else -m.pitch_rad,
        }[step.axis]
        assert moved(one.measured) > 0.15 * step.share, step
        assert moved(other.measured) < -0.15 * step.share, step
        assert settled.speed_mps < 0.6, step
    assert all(v.up_m > 4.0 for v in flown[round(start_s / STEP_S) :])


def test_a_push_down_ends_before_the_ground() -> None:
    sinking = Vehicle("velocity", sinks_faster=2.5)
    _, flown = fly("doublet", 15.0 + doublet_length_s("velocity"), sinking)
    assert min(v.up_m for v in flown[1000:]) > 3.0


def test_chunk_is_the_plan_of_the_next_seconds() -> None:
    vehicle = Vehicle("sticks")
    policy, _ = fly("square", 5.0, vehicle)
    while True:
        fly_on(policy, STEP_S, vehicle)
        chunk = policy.predict_fast(FEATURE, vehicle.state(), HISTORY, 1)[0]
        assert vehicle.now_s < 20.0
        if chunk[-1, 3] > chunk[0, 3] + 0.3:  # to the right after the corner, not yet now
            break
    assert chunk[0, 2] > chunk[-1, 2] + 0.3


def test_a_pause_of_the_loop_is_not_integrated_as_climb() -> None:
    vehicle = Vehicle("sticks", motion=drifting(0.0, 0.0, climb_mps=1.0))
    policy = ScriptedPolicy("hover", lambda: vehicle.now_s)
    policy.predict_fast(FEATURE, vehicle.state(), HISTORY, 1)
    vehicle.now_s += 60.0
    throttle = policy.predict_fast(FEATURE, vehicle.state(), HISTORY, 1)[0, 0, 0]
    assert throttle > 0.2


STATES = st.lists(st.floats(-50, 50, width=32), min_size=13, max_size=13)
TICKS = st.lists(st.tuples(st.floats(0, 5), STATES), min_size=1, max_size=10)


@given(program=st.sampled_from(PROGRAM_NAMES), ticks=TICKS)
def test_any_flight_gives_finite_sticks_in_range(program, ticks):
    now_s = 0.0
    policy = ScriptedPolicy(program, lambda: now_s)
    for step_s, state in ticks:
        now_s += step_s
        chunk = policy.predict_fast(FEATURE, np.array([state], np.float32), HISTORY, 10)
        assert np.isfinite(chunk).all()
        assert np.abs(chunk).max() <= 1.0
