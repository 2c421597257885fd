"""Scripted programs in every kind of action, flown in closed loop against a small vehicle."""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from policy.contract import ActionKind
from policy.motion.controllers import doublet_length_s, doublet_steps
from policy.motion.scripted import ScriptedPolicy
from sitl.vehicle.rotation import from_euler

STEP_S = 0.01
DELAY_STEPS = 4
"""From a state to the action that was computed from it."""
GRAVITY_MPS2 = 9.81
FEATURE, HISTORY = np.zeros((1, 8), np.float32), np.zeros((1, 4, 4), np.float32)
KINDS: tuple[ActionKind, ...] = ("sticks", "rates", "attitude", "velocity")


def beyond(stick: float, dead_zone: float) -> float:
    return math.copysign(max(0.0, abs(stick) - dead_zone) / (1 - dead_zone), stick)


@dataclass
class Vehicle:
    """Lags of first order from an action to body rate, lean, climb and velocity; may stand."""

    action: ActionKind
    hover_thrust: float = 0.39
    leaves_ground_at_s: float = 0.0
    throttle_dead_zone: float = 0.2
    sinks_faster: float = 1.0
    now_s: float = 0.0
    north_mps: float = 0.0
    east_mps: float = 0.0
    climb_mps: float = 0.0
    up_m: float = 0.0
    roll_rad: float = 0.0
    pitch_rad: float = 0.0
    yaw_rad: float = 0.0
    roll_rate: float = 0.0
    pitch_rate: float = 0.0
    yaw_rate: float = 0.0
    thrust: float = 0.0

    def state(self) -> np.ndarray:
        quaternion = from_euler(self.roll_rad, self.pitch_rad, self.yaw_rad)
        velocity = (self.north_mps, self.east_mps, -self.climb_mps)
        rates = (self.roll_rate, self.pitch_rate, self.yaw_rate)
        return np.array([[*velocity, *quaternion, *rates, 0.0, 0.0, -9.81]], np.float32)

    def step(self, action: np.ndarray) -> None:
        four = [float(number) for number in action]
        self.now_s += STEP_S
        if self.now_s < self.leaves_ground_at_s:
            return
        if self.action == "sticks":
            self._follow_sticks(*four)
        elif self.action == "velocity":
            self._follow_velocity(*four)
        else:
            self._follow_thrust(*four)
        self.yaw_rad += self.yaw_rate * STEP_S
        self.up_m += self.climb_mps * STEP_S
        if self.up_m <= 0.0 and self.climb_mps < 0.0:
            self.up_m = self.climb_mps = 0.0

    def _lag(self, wanted: float, lag_s: float, name: str) -> None:
        now: float = getattr(self, name)
        setattr(self, name, now + (wanted - now) * STEP_S / lag_s)

    def _follow_sticks(self, throttle: float, yaw: float, pitch: float, roll: float) -> None:
        full = math.radians(30.0)
        self._lag(2.5 * beyond(throttle, self.throttle_dead_zone), 0.4, "climb_mps")
        self._lag(math.radians(202.5) * beyond(yaw, 0.04), 0.1, "yaw_rate")
        self._lag(full * beyond(roll, 0.04), 0.15, "roll_rad")
        self._lag(-full * beyond(pitch, 0.04), 0.15, "pitch_rad")
        self._push(GRAVITY_MPS2, math.tan)

    def _follow_velocity(self, forward: float, right: float, down: float, yaw: float) -> None:
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        self._lag(cos * forward - sin * right, 0.4, "north_mps")
        self._lag(sin * forward + cos * right, 0.4, "east_mps")
        self._lag(-down * (self.sinks_faster if down > 0 else 1.0), 0.4, "climb_mps")
        self._lag(yaw, 0.2, "yaw_rate")

    def _follow_thrust(self, thrust: float, roll: float, pitch: float, yaw: float) -> None:
        if self.action == "attitude":
            roll, pitch = 6.0 * (roll - self.roll_rad), 6.0 * (pitch - self.pitch_rad)
        self._lag(roll, 0.06, "roll_rate")
        self._lag(pitch, 0.06, "pitch_rate")
        self._lag(yaw, 0.2, "yaw_rate")
        self.roll_rad += self.roll_rate * STEP_S
        self.pitch_rad += self.pitch_rate * STEP_S
        self._lag(thrust, 0.05, "thrust")
        accel = GRAVITY_MPS2 * self.thrust / self.hover_thrust
        up = accel * math.cos(self.roll_rad) * math.cos(self.pitch_rad)
        self._push(accel, math.sin)
        if self.up_m > 0.0 or up > GRAVITY_MPS2:
            self.climb_mps += (up - GRAVITY_MPS2 - 0.2 * self.climb_mps) * STEP_S

    def _push(self, accel: float, share: Callable[[float], float]) -> None:
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        forward, right = -accel * share(self.pitch_rad), accel * share(self.roll_rad)
        self.north_mps += (cos * forward - sin * right - 0.2 * self.north_mps) * STEP_S
        self.east_mps += (sin * forward + cos * right - 0.2 * self.east_mps) * STEP_S

    @property
    def forward_mps(self) -> float:
        return math.cos(self.yaw_rad) * self.north_mps + math.sin(self.yaw_rad) * self.east_mps

    @property
    def right_mps(self) -> float:
        return math.cos(self.yaw_rad) * self.east_mps - math.sin(self.yaw_rad) * self.north_mps

    @property
    def speed_mps(self) -> float:
        return math.hypot(self.north_mps, self.east_mps)


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
        flown.append(replace(vehicle))
    return flown


def at(flown: list[Vehicle], time_s: float) -> Vehicle:
    return flown[round(time_s / STEP_S)]


@pytest.mark.parametrize(
    "vehicle",
    [
        Vehicle("sticks", throttle_dead_zone=0.0),
        *(Vehicle(kind, thrust) for kind in KINDS[1:3] for thrust in (0.33, 0.5)),
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
    drifting = Vehicle(kind, up_m=9.0, north_mps=3.0, east_mps=-2.0, thrust=0.39)
    policy, flown = fly("hover", 10.0, drifting, starts_in_air=True)
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
    assert start_s is not None
    for step in doublet_steps(kind):
        middle_s = step.begin_s + step.half_s
        one, other = (at(flown, start_s + s - 0.02) for s in (middle_s, step.end_s))
        moved = {
            "yaw": lambda v: v.yaw_rate,
            "climb": lambda v: v.climb_mps,
            "roll": lambda v: v.right_mps if kind == "velocity" else v.roll_rad,
            "pitch": lambda v: v.forward_mps if kind == "velocity" else -v.pitch_rad,
        }[step.axis]
        assert moved(one) > 0.15 * step.share, step
        assert moved(other) < -0.15 * step.share, step
        settled = at(flown, start_s + step.end_s + step.settle_s - 0.02)
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
    vehicle = Vehicle("sticks", climb_mps=1.0)
    policy = ScriptedPolicy("hover", lambda: vehicle.now_s)
    policy.predict_fast(FEATURE, vehicle.state(), HISTORY, 1)
    vehicle.now_s += 60.0
    throttle = policy.predict_fast(FEATURE, vehicle.state(), HISTORY, 1)[0, 0, 0]
    assert throttle > 0.2
