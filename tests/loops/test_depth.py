"""Policies that see distances: of Python, flown on the stepped clock, of torch and of ONNX."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from onnx import TensorProto
from torch import Tensor

from helpers.fakes import ListSink
from helpers.foreign_graphs import FLOAT, image_actor
from mavbridge.core.errors import MavbridgeError
from mavbridge.simulation import flight as simulated
from mavbridge.simulation.flight import SimulatedFlight
from policy.contract import Contract
from policy.engines.runner import (
    ExecutionSettings,
    encode_all,
    level_state,
    make_numpy_runner,
)
from policy.engines.torch_engines import make_torch_runner
from policy.loading.load import load_policy
from policy.loading.request import PolicyRequest
from sitl.camera.fpv import FpvRenderer
from sitl.vehicle.rotation import Quat, Vec3

SIDE = 32
HELD_M = 4.0
"""The mean distance to the ground, in the lower half of the image, that the policies hold."""
GAIN = 0.25
"""Throttle for each metre that lacks."""
DEPTH = Contract(
    arrays="numpy", image_channels="depth", image_height=SIDE, image_width=SIDE, horizon=16
)


class GroundDepth(FpvRenderer):
    """The distance to the ground along the optical axis in millimetres; 0 beyond 65.5 m."""

    def render(self, position_ned_m: Vec3, ned_from_body_wxyz: Quat, *_: Any) -> Any:
        from sitl.camera.fpv import rotation_matrix

        down = (rotation_matrix(ned_from_body_wxyz) @ self._body_from_camera)[2]
        per_u, per_v, offset = down @ self._ray_from_pixel
        falls = per_u * self._u_px + (per_v * self._v_px + offset)
        depth_m = max(-position_ned_m[2], 0.12) / np.maximum(falls, 1e-6)
        return np.where(depth_m < 65.5, 1000 * depth_m, 0).astype(np.uint16)


class HoldsDistance:
    """Climbs until the ground below is as far as it should be."""

    contract = DEPTH

    def __init__(self) -> None:
        self.seen: list[np.ndarray] = []

    def predict(self, image: Any, state: Any, history: Any, steps: int) -> np.ndarray:
        self.seen.append(image)
        chunk = np.zeros((1, self.contract.horizon, 4), np.float32)
        chunk[..., 0] = np.clip(GAIN * (HELD_M - image[..., SIDE // 2 :, :].mean()), -0.5, 0.5)
        return chunk


def test_a_policy_in_python_flies_by_metres(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simulated, "FpvRenderer", GroundDepth)
    policy, sink = HoldsDistance(), ListSink()
    runner = make_numpy_runner(policy, ExecutionSettings(name="deep", dual_rate=False))
    flight = SimulatedFlight(course_seed=3, seed=0)
    assert flight.fly(runner, max_time_s=6.0, sinks=(sink,)).outcome == "timed out"
    assert {image.shape for image in policy.seen} == {(1, 1, SIDE, SIDE)}
    assert {image.dtype for image in policy.seen} == {np.dtype(np.float32)}
    held_m = policy.seen[-1][..., SIDE // 2 :, :].mean()
    assert held_m == pytest.approx(HELD_M, abs=1.0)
    assert 0.5 < -flight.vehicle.ap.truth.position_ned_m[2] < 4
    assert {vision.rgb.dtype for vision in sink.visions} == {np.dtype(np.uint16)}
    assert {vision.fault for vision in sink.visions} == {None}


class TwoRates(torch.nn.Module):
    """Gives what it is given: the mean distance of each camera at each time."""

    contract = replace(
        DEPTH,
        arrays="torch",
        feature_dim=1,
        cameras=("front", "down"),
        observation_steps=2,
    )

    def encode_visual(self, image: Tensor, camera: int) -> Tensor:
        assert image.shape == (1, 1, SIDE, SIDE)
        assert image.dtype == torch.float32
        return image.mean(dim=(2, 3))

    def predict_fast(self, feature: Tensor, state: Tensor, history: Tensor, steps: int) -> Tensor:
        return feature.reshape(1, 1, 4).expand(-1, self.contract.horizon, -1)

    def predict(self, image: Tensor, state: Tensor, history: Tensor, steps: int) -> Tensor:
        return self.predict_fast(image.mean(dim=(3, 4, 5)), state, history, steps)


def metres(*shape: int) -> np.ndarray:
    """Images of 1, 2, 3 ... metres, each of one distance, as cameras send them."""
    each = 1000 * np.arange(1, np.prod(shape) + 1, dtype=np.uint16).reshape(*shape, 1, 1)
    return np.broadcast_to(each, (*shape, 40, 50))


@pytest.mark.parametrize("dual_rate", [True, False])
def test_a_policy_in_torch_gets_metres_of_all_cameras_and_times(dual_rate: bool) -> None:
    settings = ExecutionSettings(name="deep", dual_rate=dual_rate)
    runner = make_torch_runner(TwoRates(), settings)
    state, history = level_state(TwoRates.contract), np.zeros((1, 4, 4), np.float32)
    chunk = runner.act(encode_all(runner, metres(2, 2)), state, history)
    assert chunk[0, 0] == pytest.approx([1, 2, 3, 4])


def request(folder: Path, kind: int) -> PolicyRequest:
    """A graph that gives the mean of its image."""
    image_actor(folder / "policy.onnx", kind=kind, shape=(1, 1, SIDE, SIDE))
    (folder / "mavbridge.toml").write_text(
        '[contract]\nhorizon = 1\nchunk_dt_s = 0.05\nimage_channels = "depth"\n'
        f"image_height = {SIDE}\nimage_width = {SIDE}\n"
        '[images]\nfront = "image"\n'
    )
    return PolicyRequest(spec=f"onnx:{folder / 'policy.onnx'}")


def test_a_graph_gets_metres(tmp_path: Path) -> None:
    with load_policy(request(tmp_path, FLOAT), now_s=lambda: 0.0) as loaded:
        runner = loaded.runner
        state, history = level_state(runner.contract), np.zeros((1, 4, 4), np.float32)
        chunk = runner.act(encode_all(runner, metres(1, 1)), state, history)
    assert chunk[0, 0] == pytest.approx([1, 1, 1, 1])


def test_a_graph_that_takes_bytes_is_no_policy_of_depth(tmp_path: Path) -> None:
    with pytest.raises(MavbridgeError, match="depth in metres"):
        load_policy(request(tmp_path, TensorProto.UINT8), now_s=lambda: 0.0)
