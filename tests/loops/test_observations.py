"""A policy that looks through two cameras and back in time, flown in memory."""

from typing import Any

import numpy as np
import pytest

from helpers.fakes import ListSink
from mavbridge.config.flight import FlyConfig
from mavbridge.core.clock import NS_PER_MS, NS_PER_S, Clock
from mavbridge.core.errors import UserError
from mavbridge.simulation.flight import SimulatedFlight, SimulationSettings
from mavbridge.simulation.world import make_vehicle
from policy.contract import Contract
from policy.engines.runner import ExecutionSettings, make_numpy_runner

MS = NS_PER_MS
STEP_NS = 100 * MS
TWO_EYES = Contract(
    arrays="numpy",
    feature_dim=2,
    image_height=32,
    image_width=32,
    since_exposure=True,
    cameras=("front", "down"),
    camera_rates_hz=(30.0, 10.0),
    observation_steps=2,
    observation_dt_s=0.1,
)


class Watchful:
    """Climbs, leaning now and then, and remembers when it saw what."""

    def __init__(self, clock: Clock, contract: Contract = TWO_EYES) -> None:
        self.contract = contract
        self._clock = clock
        self.brightness: list[list[float]] = [[], []]
        self.encoded_ns: list[list[int]] = [[], []]
        self.calls: list[tuple[int, np.ndarray, np.ndarray]] = []

    def encode_visual(self, image: np.ndarray, camera: int) -> np.ndarray:
        self.brightness[camera].append(float(image.mean()))
        self.encoded_ns[camera].append(self._clock.now_ns())
        return np.array([[len(self.encoded_ns[camera]) - 1, camera]], np.float32)

    def predict_fast(self, feature: Any, state: Any, history: Any, steps: int) -> np.ndarray:
        self.calls.append((self._clock.now_ns(), feature, state))
        chunk = np.zeros((1, self.contract.horizon, 4), np.float32)
        chunk[..., 0], chunk[..., 2] = 0.5, 0.3 * np.sin(self._clock.now_ns() / NS_PER_S)
        return chunk

    predict = predict_fast


@pytest.fixture(scope="module")
def flown() -> tuple[Watchful, ListSink]:
    one, sink = SimulatedFlight(course_seed=3, seed=0), ListSink()
    policy = Watchful(one.clock)
    runner = make_numpy_runner(policy, ExecutionSettings(name="watchful"))
    policy.calls.clear()
    for seen in (*policy.encoded_ns, *policy.brightness):
        seen.clear()  # of the trial
    result = one.fly(runner, max_time_s=2.0, sinks=(sink,))
    assert result.outcome == "timed out"
    assert -one.vehicle.ap.truth.position_ned_m[2] > 1.0
    return policy, sink


def test_each_camera_has_a_rate_and_a_view_of_its_own(flown: tuple[Watchful, ListSink]) -> None:
    front, down = (np.diff(stamps) for stamps in flown[0].encoded_ns)
    assert np.median(front) / MS == pytest.approx(1000 / 30, abs=4)
    assert np.median(down) / MS == pytest.approx(100, abs=8)
    bright, dark = (np.mean(seen) for seen in flown[0].brightness)
    assert bright - dark > 0.2  # there is sky ahead, and none below


def test_a_past_image_is_one_step_older_than_the_newest(
    flown: tuple[Watchful, ListSink],
) -> None:
    policy, _ = flown
    settled = [call for call in policy.calls if call[0] > policy.calls[0][0] + 300 * MS]
    assert len(settled) > 150
    for _, feature, _ in settled:
        assert feature.shape == (1, 2, 4)
        (front_then, front, down_then, down) = feature[0, :, [0, 2]].ravel().astype(int)
        assert feature[0, :, [1, 3]].tolist() == [[0, 0], [1, 1]]  # by camera, at both times
        for camera, then, newest in ((0, front_then, front), (1, down_then, down)):
            stamps_ns = policy.encoded_ns[camera]
            gap_ns = stamps_ns[newest] - stamps_ns[then]
            assert abs(gap_ns - STEP_NS) < 25 * MS  # half a period of the camera, and its jitter


def test_the_simulator_says_which_cameras_it_has() -> None:
    one = SimulatedFlight(course_seed=3, seed=0, settings=SimulationSettings(draw_images=False))
    contract = Contract(arrays="numpy", feature_dim=2, cameras=("front", "wrist"))
    runner = make_numpy_runner(Watchful(one.clock, contract), ExecutionSettings(name="w"))
    with pytest.raises(UserError, match=r"no cameras \['wrist'\].*front, down, left, right, back"):
        one.fly(runner, max_time_s=1.0)


class GoalSeeker(Watchful):
    """Flies to its goal by velocities."""

    def encode_visual(self, image: np.ndarray, camera: int = 0) -> np.ndarray:
        return np.zeros((1, 1), np.float32)

    def predict_fast(self, feature: Any, state: Any, history: Any, steps: int) -> np.ndarray:
        self.calls.append((self._clock.now_ns(), feature, state))
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
    policy.calls.clear()
    one.fly(runner, max_time_s=12.0)
    place_ned_m = np.array(one.vehicle.ap.truth.position_ned_m)
    assert place_ned_m == pytest.approx(goal, abs=0.4)
    _, _, state = policy.calls[-1]
    assert state.shape == (1, 18)
    np.testing.assert_allclose(state[0, 13:16], np.array(goal) - place_ned_m, atol=0.3)
    np.testing.assert_allclose(state[0, 16:], -place_ned_m[2], atol=0.3)
