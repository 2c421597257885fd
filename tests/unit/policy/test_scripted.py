import math
from dataclasses import dataclass

import numpy as np
import pytest

from policy.errors import PolicyError
from policy.protocol import DualRatePolicy
from policy.scripted import PROGRAM_NAMES, ScriptedPolicy

STEP_S = 0.01
LEAN_ACCEL_MPS2 = 9.81 * math.tan(math.radians(30))


def beyond(stick: float, deadzone: float) -> float:
    return math.copysign(max(0.0, abs(stick) - deadzone) / (1 - deadzone), stick)


@dataclass
class PointMass:
    """A vehicle that holds altitude at mid-stick: every response is of first order."""

    leaves_ground_at_s: float = 0.0
    throttle_deadzone: float = 0.2
    now_s: float = 0.0
    north_m: float = 0.0
    east_m: float = 0.0
    up_m: float = 0.0
    north_mps: float = 0.0
    east_mps: float = 0.0
    climb_mps: float = 0.0
    heading_rad: float = 0.0
    yaw_rate_radps: float = 0.0
    forward_accel_mps2: float = 0.0
    right_accel_mps2: float = 0.0

    def state(self) -> np.ndarray:
        half = self.heading_rad / 2
        values = [self.north_mps, self.east_mps, -self.climb_mps]
        values += [math.cos(half), 0.0, 0.0, math.sin(half), 0.0, 0.0, self.yaw_rate_radps]
        return np.array([[*values, 0.0, 0.0, -9.81]], np.float32)

    def step(self, sticks: np.ndarray) -> None:
        throttle, yaw, pitch, roll = (float(stick) for stick in sticks)
        self.now_s += STEP_S
        if self.now_s < self.leaves_ground_at_s:
            return
        climb = 2.5 * beyond(throttle, self.throttle_deadzone)
        self.climb_mps += (climb - self.climb_mps) * STEP_S / 0.4
        self.up_m += self.climb_mps * STEP_S
        if self.up_m < 0.0:
            self.up_m, self.climb_mps = 0.0, 0.0
        rate = math.radians(202.5) * beyond(yaw, 0.04)
        self.yaw_rate_radps += (rate - self.yaw_rate_radps) * STEP_S / 0.1
        self.heading_rad += self.yaw_rate_radps * STEP_S
        forward, right = (LEAN_ACCEL_MPS2 * beyond(stick, 0.04) for stick in (pitch, roll))
        self.forward_accel_mps2 += (forward - self.forward_accel_mps2) * STEP_S / 0.15
        self.right_accel_mps2 += (right - self.right_accel_mps2) * STEP_S / 0.15
        cos, sin = math.cos(self.heading_rad), math.sin(self.heading_rad)
        north = cos * self.forward_accel_mps2 - sin * self.right_accel_mps2
        east = sin * self.forward_accel_mps2 + cos * self.right_accel_mps2
        self.north_mps += (north - 0.2 * self.north_mps) * STEP_S
        self.east_mps += (east - 0.2 * self.east_mps) * STEP_S
        self.north_m += self.north_mps * STEP_S
        self.east_m += self.east_mps * STEP_S


FEATURE, HISTORY = np.zeros((1, 8), np.float32), np.zeros((1, 4, 4), np.float32)


def fly(program: str, duration_s: float, vehicle: PointMass) -> list[PointMass]:
    """Closed loop at 100 Hz; copies of the vehicle, one a step."""
    policy = ScriptedPolicy(program, lambda: vehicle.now_s)
    flown = []
    for _ in range(round(duration_s / STEP_S)):
        chunk = policy.predict_fast(FEATURE, vehicle.state(), HISTORY, 10)
        vehicle.step(chunk[0, 0])
        flown.append(PointMass(**vars(vehicle)))
    return flown


def start_of_program(flown: list[PointMass]) -> int:
    return next(index for index, v in enumerate(flown) if v.up_m > 2.8) + 200


@pytest.mark.parametrize("deadzone", [0.0, 0.2])
@pytest.mark.parametrize("late_s", [0.0, 3.0])
def test_takes_off_to_three_metres_and_stays(late_s: float, deadzone: float) -> None:
    vehicle = PointMass(leaves_ground_at_s=late_s, throttle_deadzone=deadzone)
    flown = fly("hover", late_s + 20.0, vehicle)
    assert max(v.up_m for v in flown) < 3.5
    settled = flown[round((late_s + 6.0) / STEP_S) :]
    assert all(2.5 < v.up_m < 3.5 for v in settled)
    assert max(abs(v.climb_mps) for v in settled[500:]) < 0.2


def test_reset_begins_again_from_the_altitude_of_now() -> None:
    vehicle = PointMass()
    policy = ScriptedPolicy("square", lambda: vehicle.now_s)

    def fly_on(duration_s: float) -> None:
        for _ in range(round(duration_s / STEP_S)):
            vehicle.step(policy.predict_fast(FEATURE, vehicle.state(), HISTORY, 10)[0, 0])

    fly_on(10.0)
    assert vehicle.up_m == pytest.approx(3.0, abs=0.5)
    policy.reset()
    fly_on(4.0)
    assert vehicle.up_m == pytest.approx(6.0, abs=0.7)
    assert math.hypot(vehicle.north_mps, vehicle.east_mps) < 0.25


def test_hover_stops_a_drift() -> None:
    vehicle = PointMass(north_mps=2.0, east_mps=-1.0)
    last = fly("hover", 12.0, vehicle)[-1]
    assert math.hypot(last.north_mps, last.east_mps) < 0.25


def test_square_flies_its_legs_in_order_and_comes_back() -> None:
    flown = fly("square", 40.0, PointMass())
    start = start_of_program(flown)
    for leg, (north, east) in enumerate([(1.5, 0.0), (0.0, 1.5), (-1.5, 0.0), (0.0, -1.5)]):
        end = flown[start + (leg + 1) * 400 - 10]
        assert end.north_mps == pytest.approx(north, abs=0.35)
        assert end.east_mps == pytest.approx(east, abs=0.35)
    corner, back = flown[start + 800], flown[start + 1600]
    assert corner.north_m - flown[start].north_m > 4.0
    assert corner.east_m - flown[start].east_m > 3.0
    assert math.hypot(back.north_m - flown[start].north_m, back.east_m - flown[start].east_m) < 2.0
    assert all(2.5 < v.up_m < 3.5 for v in flown[start:])


def test_circle_turns_while_it_flies() -> None:
    flown = fly("circle", 40.0, PointMass())
    lap = flown[start_of_program(flown) + 500 :][:1200]
    assert lap[-1].heading_rad - lap[0].heading_rad == pytest.approx(2 * math.pi, rel=0.25)
    speeds = [math.hypot(v.north_mps, v.east_mps) for v in lap]
    assert min(speeds) > 1.0
    assert max(speeds) < 2.0
    assert 3.0 < max(v.north_m for v in lap) - min(v.north_m for v in lap) < 9.0


def test_yaw_turns_on_the_spot() -> None:
    flown = fly("yaw", 20.0, PointMass())
    start = start_of_program(flown)
    turned = flown[start + 500].heading_rad - flown[start].heading_rad
    assert turned == pytest.approx(5 * math.radians(30), rel=0.25)
    assert max(math.hypot(v.north_m, v.east_m) for v in flown) < 0.2


def test_heading_frame_is_used_not_north() -> None:
    facing_east = PointMass(heading_rad=math.pi / 2)
    flown = fly("square", 12.0, facing_east)
    first_leg_end = flown[start_of_program(flown) + 390]
    assert first_leg_end.east_mps == pytest.approx(1.5, abs=0.35)
    assert abs(first_leg_end.north_mps) < 0.2


def test_chunk_is_the_plan_of_the_next_seconds() -> None:
    vehicle = PointMass()
    policy = ScriptedPolicy("square", lambda: vehicle.now_s)
    while not (vehicle.up_m > 2.8 and policy_turns(policy, vehicle)):
        vehicle.step(policy.predict_fast(FEATURE, vehicle.state(), HISTORY, 1)[0, 0])
        assert vehicle.now_s < 20.0
    chunk = policy.predict_fast(FEATURE, vehicle.state(), HISTORY, 1)[0]
    pitch, roll = chunk[:, 2], chunk[:, 3]
    assert pitch[0] > pitch[-1] + 0.3  # forward now, not any more after the corner
    assert roll[-1] > roll[0] + 0.3


def policy_turns(policy: ScriptedPolicy, vehicle: PointMass) -> bool:
    """Whether the chunk holds the corner from the first leg to the second."""
    chunk = policy.predict_fast(FEATURE, vehicle.state(), HISTORY, 1)[0]
    return bool(chunk[-1, 3] > chunk[0, 3] + 0.3)


def test_a_pause_of_the_loop_is_not_integrated_as_climb() -> None:
    vehicle = PointMass(climb_mps=1.0)
    policy = ScriptedPolicy("hover", lambda: vehicle.now_s)
    policy.predict_fast(FEATURE, vehicle.state(), HISTORY, 1)
    vehicle.now_s += 60.0
    throttle = policy.predict_fast(FEATURE, vehicle.state(), HISTORY, 1)[0, 0, 0]
    assert throttle > 0.2


@pytest.mark.parametrize("program", PROGRAM_NAMES)
def test_speaks_the_whole_protocol(program: str) -> None:
    policy = ScriptedPolicy(program, lambda: 0.0)
    assert isinstance(policy, DualRatePolicy)
    image = np.random.default_rng(0).normal(size=(1, 3, 224, 224)).astype(np.float32)
    feature = policy.encode_visual(image)
    assert feature.shape == (1, policy.contract.feature_dim)
    assert feature.dtype == np.float32
    np.testing.assert_allclose(feature[0, :3], image.mean(axis=(0, 2, 3)), atol=0.05)
    chunk = policy.predict(image, PointMass().state(), HISTORY, 10)
    assert chunk.shape == (1, 16, 4)
    assert chunk.dtype == np.float32


def test_refuses_what_it_cannot_fly() -> None:
    with pytest.raises(PolicyError, match="hover"):
        ScriptedPolicy("loop", lambda: 0.0)
    with pytest.raises(PolicyError, match=r"\[1, 13\]"):
        ScriptedPolicy("hover", lambda: 0.0).predict_fast(FEATURE, np.zeros((2, 13)), HISTORY, 1)
