"""Policies that look through two cameras and fly to a goal, flown in memory."""

from typing import Any

import numpy as np
import pytest

from mavbridge.config.flight import FlyConfig
from mavbridge.core.clock import NS_PER_MS, Clock
from mavbridge.core.errors import UserError
from mavbridge.simulation.flight import SimulatedFlight, SimulationSettings
from mavbridge.simulation.world import make_vehicle
from policy.contract import Contract
from policy.engines.runner import ExecutionSettings, make_numpy_runner

TWO_EYES = Contract(
    arrays="numpy",
    feature_dim=1,
    image_height=32,
    image_width=32,
    cameras=("front", "down"),
    camera_rates_hz=(30.0, 10.0),
)


class Watchful:
    """Climbs, and remembers when it saw what."""

    def __init__(self, clock: Clock, contract: Contract = TWO_EYES) -> None:
        self.contract = contract
        self._clock = clock
        self.brightness: list[list[float]] = [[], []]
        self.encoded_ns: list[list[int]] = [[], []]

    def encode_visual(self, image: np.ndarray, camera: int) -> np.ndarray:
        self.brightness[camera].append(float(image.mean()))
        self.encoded_ns[camera].append(self._clock.now_ns())
        return np.zeros((1, 1), np.float32)

    def predict_fast(self, feature: Any, state: Any, history: Any, steps: int) -> np.ndarray:
        chunk = np.zeros((1, self.contract.horizon, 4), np.float32)
        chunk[..., 0] = 0.5
        return chunk

    predict = predict_fast


def test_each_camera_has_a_rate_and_a_view_of_its_own() -> None:
    one = SimulatedFlight(course_seed=3, seed=0)
    policy = Watchful(one.clock)
    runner = make_numpy_runner(policy, ExecutionSettings(name="watchful"))
    for seen in (*policy.encoded_ns, *policy.brightness):
        seen.clear()  # of the trial
    one.fly(runner, max_time_s=1.5)
    front, down = (np.diff(stamps) / NS_PER_MS for stamps in policy.encoded_ns)
    assert np.median(front) == pytest.approx(1000 / 30, abs=4)
    assert np.median(down) == pytest.approx(100, abs=8)
    bright, dark = map(np.mean, policy.brightness)
    assert bright - dark > 0.2  # there is sky ahead, and none below


def test_the_simulator_says_which_cameras_it_has() -> None:
    one = SimulatedFlight(course_seed=3, seed=0, settings=SimulationSettings(draw_images=False))
    contract = Contract(arrays="numpy", feature_dim=1, cameras=("front", "wrist"))
    runner = make_numpy_runner(Watchful(one.clock, contract), ExecutionSettings(name="w"))
    with pytest.raises(UserError, match=r"no cameras \['wrist'\].*front, down, left, right, back"):
        one.fly(runner, max_time_s=1.0)


class GoalSeeker(Watchful):
    """Flies to its goal by velocities."""

    state: Any = None
    """The newest one."""

    def encode_visual(self, image: np.ndarray, camera: int = 0) -> np.ndarray:
        return np.zeros((1, 1), np.float32)

    def predict_fast(self, feature: Any, state: Any, history: Any, steps: int) -> np.ndarray:
        self.state = state
        chunk = np.zeros((1, self.contract.horizon, 4), np.float32)
        to_goal, distance_m = state[0, 13:16], float(np.linalg.norm(state[0, 13:16]))
        chunk[..., :3] = min(2.0, distance_m) * to_goal / max(distance_m, 1e-3)
        return chunk


def test_goal_height_and_altitude_are_those_of_the_vehicle() -> None:
    goal = (3.0, -2.0, -4.0)
    one = SimulatedFlight(
        course_seed=3,
        seed=0,
        settings=SimulationSettings(config=FlyConfig(goal="3,-2,-4"), draw_images=False),
        vehicle=make_vehicle(autopilot="px4"),
    )
    contract = Contract(
        arrays="numpy",
        feature_dim=1,
        action="velocity",
        state_extras=("goal", "height", "altitude"),
        image_height=32,
        image_width=32,
    )
    policy = GoalSeeker(one.clock, contract)
    runner = make_numpy_runner(policy, ExecutionSettings(name="seeker"))
    one.fly(runner, max_time_s=12.0)
    place_ned_m = np.array(one.vehicle.ap.truth.position_ned_m)
    assert place_ned_m == pytest.approx(goal, abs=0.4)
    state = policy.state
    assert state.shape == (1, 18)
    np.testing.assert_allclose(state[0, 13:16], np.array(goal) - place_ned_m, atol=0.3)
    np.testing.assert_allclose(state[0, 16:], -place_ned_m[2], atol=0.3)
