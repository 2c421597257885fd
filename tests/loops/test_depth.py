"""Policies that see distances, of torch and of ONNX."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from onnx import TensorProto
from torch import Tensor

from helpers.foreign_graphs import FLOAT, image_actor
from mavbridge.core.errors import MavbridgeError
from policy.contract import Contract
from policy.engines.runner import (
    ExecutionSettings,
    encode_all,
    level_state,
)
from policy.engines.torch_engines import make_torch_runner
from policy.loading.load import load_policy
from policy.loading.request import PolicyRequest

SIDE = 32
DEPTH = Contract(
    arrays="numpy", image_channels="depth", image_height=SIDE, image_width=SIDE, horizon=16
)


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
