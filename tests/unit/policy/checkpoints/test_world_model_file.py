"""World models on disk, and every way in which a file can be the wrong one."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from policy.checkpoints.networks import load_world_model, save_checkpoint, save_world_model
from policy.checkpoints.tensors import read_tensors
from policy.contract import Contract
from policy.errors import CheckpointError
from policy.nets.diffusion import NoiseSchedule
from policy.nets.world_model.config import WorldModelConfig
from policy.nets.world_model.model import WorldModel

CONFIG = WorldModelConfig(
    image_size=32,
    latent_channels=3,
    frames=4,
    frame_dt_s=0.2,
    horizontal_fov_rad=1.2,
    camera_tilt_rad=-0.1,
    autoencoder_widths=(8, 8, 16),
    dynamics_width=32,
    dynamics_depth=1,
    contract=Contract(state_frame="enu_flu", image_height=32, image_width=32),
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
    latents = torch.randn(2, 3, 4, 4, generator=torch.Generator().manual_seed(0))
    shown, wanted = loaded.decode(latents).float(), model.decode(latents).float()
    assert (shown - wanted).abs().max() <= 1


def test_another_file_is_refused(small_toge, model, tmp_path):
    path = tmp_path / "world.safetensors"
    with pytest.raises(CheckpointError, match=r"stored as \.safetensors"):
        load_world_model(tmp_path / "world.pt")
    save_world_model(path, model)
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(CheckpointError, match="cut short"):
        load_world_model(path)
    save_checkpoint(path, small_toge)
    with pytest.raises(CheckpointError, match="holds a policy"):
        load_world_model(path)
    save_file({name: value.contiguous() for name, value in model.state_dict().items()}, path)
    with pytest.raises(CheckpointError, match="holds no world model"):
        load_world_model(path)


def test_weights_that_are_not_finite_or_do_not_fit_are_refused(model, tmp_path):
    path = tmp_path / "world.safetensors"
    save_world_model(path, model)
    before, sick = path.read_bytes(), WorldModel(CONFIG)
    for value in (float("nan"), 1e6):  # the second is no float16
        sick.action_mean[1] = value
        with pytest.raises(CheckpointError, match="action_mean"):
            save_world_model(path, sick)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
    header = read_tensors(path)[0]
    state = load_file(path)
    save_file({**state, "action_std": torch.full((4,), float("inf"))}, path, metadata=header)
    with pytest.raises(CheckpointError, match="action_std"):
        load_world_model(path)
    del state["action_std"]
    save_file(state, path, metadata=header)
    with pytest.raises(CheckpointError, match="missing 'action_std'"):
        load_world_model(path)


@pytest.mark.parametrize(
    ("key", "text", "says"),
    [
        ("world_model", "[" * 100_000, "malformed"),
        ("world_model", CONFIG.to_json().replace('"frames": 4', '"frames": 0'), "frame_position"),
        ("contract", "{}x", "not JSON"),
    ],
)
def test_headers_of_another_make_are_refused(model, tmp_path, key, text, says):
    path = tmp_path / "world.safetensors"
    save_world_model(path, model)
    header, state = read_tensors(path)
    save_file(state, path, metadata={**header, key: text})
    with pytest.raises(CheckpointError, match=says):
        load_world_model(path)


def test_a_path_that_cannot_be_written_is_told(model, tmp_path):
    for name, says in (("missing/a.safetensors", "cannot write"), ("a.pt", "rename")):
        with pytest.raises(CheckpointError, match=says):
            save_world_model(tmp_path / name, model)
