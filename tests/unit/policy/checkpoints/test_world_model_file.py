"""World models on disk, and every way in which a file can be the wrong one."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from helpers.training_runs import SMALL_WORLD
from policy.checkpoints.networks import (
    config_json,
    load_world_model,
    save_checkpoint,
    save_world_model,
)
from policy.checkpoints.tensors import read_tensors
from policy.errors import CheckpointError
from policy.nets.diffusion import NoiseSchedule
from policy.nets.world_model.model import WorldModel

CONFIG = replace(
    SMALL_WORLD,
    frame_dt_s=0.2,
    horizontal_fov_rad=1.2,
    camera_tilt_rad=-0.1,
    contract=replace(SMALL_WORLD.contract, state_frame="enu_flu"),
    schedule=NoiseSchedule(betas="linear"),
)


@pytest.fixture(scope="module")
def model() -> WorldModel:
    """Not to be changed by a test."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return WorldModel(CONFIG).eval()


def test_a_file_alone_says_what_it_is_in_half_precision(model: WorldModel, tmp_path: Path) -> None:
    path = tmp_path / "world.safetensors"
    save_world_model(path, model, training='{"flights": 3}')
    loaded = load_world_model(path)
    assert loaded.config == CONFIG
    assert not loaded.training
    for name, value in model.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], value.half().float()), name
    assert read_tensors(path)[0]["training"] == '{"flights": 3}'
    assert list(tmp_path.iterdir()) == [path]
    latents = torch.randn(2, 4, 4, 4, generator=torch.Generator().manual_seed(0))
    shown, wanted = loaded.decode(latents).float(), model.decode(latents).float()
    assert (shown - wanted).abs().max() <= 1


def test_another_file_is_refused(small_toge, model, tmp_path):
    path = tmp_path / "world.safetensors"
    with pytest.raises(CheckpointError, match=r"one of \.safetensors"):
        load_world_model(tmp_path / "world.pt")
    save_checkpoint(path, small_toge)
    with pytest.raises(CheckpointError, match="holds a policy"):
        load_world_model(path)
    save_file({name: value.contiguous() for name, value in model.state_dict().items()}, path)
    with pytest.raises(CheckpointError, match="holds no world model"):
        load_world_model(path)


def test_what_cannot_be_written_is_told_and_leaves_the_file_before(model, tmp_path):
    path = tmp_path / "world.safetensors"
    save_world_model(path, model)
    before, sick = path.read_bytes(), WorldModel(CONFIG)
    for value in (float("nan"), 1e6):  # the second is no float16
        sick.action_mean[1] = value
        with pytest.raises(CheckpointError, match="action_mean"):
            save_world_model(path, sick)
    for name, says in (("missing/a.safetensors", "cannot write"), ("a.pt", "rename")):
        with pytest.raises(CheckpointError, match=says):
            save_world_model(tmp_path / name, model)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("header", "weights", "says"),
    [
        ({"world_model": "[" * 100_000}, {}, "malformed"),
        ({"world_model": config_json(replace(CONFIG, frames=8))}, {}, "frame_position"),
        ({"world_model": config_json(replace(CONFIG, autoencoder_widths=()))}, {}, "out of range"),
        ({"world_model": config_json(replace(CONFIG, dynamics_width=10**6))}, {}, "few .*Train"),
        ({"world_model": config_json(replace(CONFIG, dynamics_depth=10**9))}, {}, "few .*Train"),
        ({"contract": "{}x"}, {}, "not JSON"),
        ({}, {"action_std": torch.full((4,), float("inf"))}, "NaN or infinity.*action_std"),
        ({}, {"action_std": torch.ones(5)}, r"'action_std' is \[5\], must be \[4\]"),
    ],
)
def test_headers_and_weights_of_another_make_are_refused(model, tmp_path, header, weights, says):
    path = tmp_path / "world.safetensors"
    save_world_model(path, model)
    right_header, state = read_tensors(path)
    save_file({**state, **weights}, path, metadata={**right_header, **header})
    with pytest.raises(CheckpointError, match=says):
        load_world_model(path)
