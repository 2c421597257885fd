"""Several observations and cameras, through every engine that runs on a CPU."""

from typing import Any

import numpy as np
import pytest

from policy.contract import Contract
from policy.engines.parity import make_parity_samples
from policy.engines.runner import (
    ExecutionSettings,
    encode_all,
    level_state,
    make_numpy_runner,
)
from policy.protocol import PolicyRunner

SMALL = {"image_height": 16, "image_width": 24, "horizon": 2, "feature_dim": 3}
GREYS = np.array([[10, 20], [30, 40]], np.uint8)
"""Brightness of the image of each camera at each of two observations."""
HISTORY = np.zeros((1, 4, 4), np.float32)


def contract_of(steps: int, cameras: int, arrays: Any = "numpy") -> Contract:
    return Contract(
        observation_steps=steps,
        cameras=("front", "down")[:cameras],
        arrays=arrays,
        image_mean_rgb=(0.0, 0.0, 0.0),
        image_std_rgb=(1 / 255, 1 / 255, 1 / 255),
        **SMALL,
    )


class Remembering:
    """Feature: mean grey, and the camera's place; keeps what it was given."""

    def __init__(self, contract: Contract) -> None:
        self.contract = contract
        self.given: Any = None

    def encode_visual(self, image: np.ndarray, camera: int = 0) -> np.ndarray:
        grey = float(image.mean())
        return np.array([[grey, camera, 0.0]], np.float32)

    def predict_fast(self, feature: Any, state: Any, history: Any, steps: int) -> np.ndarray:
        self.given = feature, state
        return np.zeros((1, 2, 4), np.float32)

    predict = predict_fast


def seen_by(runner: PolicyRunner, policy: Remembering) -> tuple[np.ndarray, np.ndarray]:
    contract = runner.contract
    steps, cameras = contract.observation_steps, len(contract.cameras)
    rgb = np.empty((steps, cameras, 30, 40, 3), np.uint8)
    rgb[:] = GREYS[:steps, :cameras, None, None, None]
    runner.act(encode_all(runner, rgb), level_state(contract), HISTORY)
    encoded, state = policy.given
    assert state.shape == (1, *contract.state_shape)
    return encoded, state


@pytest.mark.parametrize(
    ("steps", "cameras", "expected"),
    [
        (1, 1, [10, 0, 0]),
        (1, 2, [10, 0, 0, 20, 1, 0]),
        (2, 1, [[10, 0, 0], [30, 0, 0]]),
        (2, 2, [[10, 0, 0, 20, 1, 0], [30, 0, 0, 40, 1, 0]]),
    ],
)
def test_features_stand_side_by_side_by_camera_and_oldest_first(steps, cameras, expected):
    policy = Remembering(contract_of(steps, cameras))
    runner = make_numpy_runner(policy, ExecutionSettings(name="mine"))
    feature, _ = seen_by(runner, policy)
    assert feature.shape == (1, *policy.contract.feature_shape)
    np.testing.assert_allclose(feature[0], expected, atol=1e-4)


@pytest.mark.parametrize(
    ("steps", "cameras", "expected"),
    [(1, 1, 10), (1, 2, [10, 20]), (2, 1, [10, 30]), (2, 2, GREYS)],
)
def test_single_rate_images_keep_camera_and_time_apart(steps, cameras, expected):
    policy = Remembering(contract_of(steps, cameras))
    settings = ExecutionSettings(name="mine", dual_rate=False)
    image, _ = seen_by(make_numpy_runner(policy, settings), policy)
    assert image.shape == (1, *policy.contract.image_shape)
    np.testing.assert_allclose(image[0].mean(axis=(-3, -2, -1)), expected, atol=1e-4)


def test_parity_samples_have_every_extra_input() -> None:
    contract = Contract(
        observation_steps=2, since_exposure=True, state_extras=("goal", "height", "altitude")
    )
    samples = make_parity_samples(contract)
    assert samples.state.shape == (4, 2, 25)
    assert samples.rgb.shape == (4, 2, 224, 224, 3)
    assert np.abs(samples.state).min(axis=(0, 1)).min() > 0
    np.testing.assert_allclose(np.linalg.norm(samples.state[..., 3:7], axis=-1), 1, atol=1e-6)
