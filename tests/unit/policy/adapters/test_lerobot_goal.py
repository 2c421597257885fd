"""Diffusion policies of LeRobot that fly to a goal, with and without a camera."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file, save_file

from policy.adapters.lerobot.config import ENVIRONMENT_KEY
from policy.adapters.lerobot.plan import read_plan
from policy.adapters.lerobot.policy import LeRobotDiffusion, build_policy_of
from policy.engines.runner import level_state

GOLDENS = Path(__file__).parents[3] / "data" / "lerobot"
STATISTICS = "policy_preprocessor_step_3_normalizer_processor.safetensors"


@pytest.fixture(params=["with a camera", "without"])
def folder(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """The kept diffusion policy with a goal as its environment."""
    shutil.copytree(GOLDENS / "diffusion", tmp_path, dirs_exist_ok=True)
    config = json.loads((tmp_path / "config.json").read_text())
    if request.param == "without":
        del config["input_features"]["observation.images.front"]
    config["input_features"][ENVIRONMENT_KEY] = {"type": "ENV", "shape": [3]}
    config["normalization_mapping"]["ENV"] = "MEAN_STD"
    (tmp_path / "config.json").write_text(json.dumps(config))
    preprocessor = json.loads((tmp_path / "policy_preprocessor.json").read_text())
    for step in preprocessor["steps"]:
        if step.get("registry_name") == "normalizer_processor":
            step["config"]["norm_map"]["ENV"] = "MEAN_STD"
    (tmp_path / "policy_preprocessor.json").write_text(json.dumps(preprocessor))
    statistics = load_file(tmp_path / STATISTICS)
    statistics[f"{ENVIRONMENT_KEY}.mean"] = np.array([10.0, 0.0, 0.0], np.float32)
    statistics[f"{ENVIRONMENT_KEY}.std"] = np.array([2.0, 1.0, 1.0], np.float32)
    save_file(statistics, tmp_path / STATISTICS)
    (tmp_path / "mavbridge.toml").write_text('[contract]\nchunk_dt_s = 0.1\naction = "velocity"\n')
    save_file({}, tmp_path / "model.safetensors")
    return tmp_path


def test_the_condition_is_state_images_environment_as_in_lerobot(folder: Path) -> None:
    policy = build_policy_of(read_plan(folder, None)).eval()
    assert isinstance(policy, LeRobotDiffusion)
    contract = policy.contract
    assert contract.state_extras == ("goal",)
    state = torch.randn(1, 2, 16, generator=torch.Generator().manual_seed(0))
    feature = torch.arange(2.0 * contract.feature_dim).reshape(1, 2, -1)
    seen, own_state = policy._network_inputs(feature, state)
    condition = torch.cat([own_state, seen.flatten(2)], dim=-1)
    images = 0 if contract.image_height == 16 else contract.feature_dim
    assert condition.shape == (1, 2, 13 + images + 3)
    assert torch.equal(condition[..., 13 : 13 + images], feature[..., :images])
    goal = (state[..., 13:] - torch.tensor([10.0, 0.0, 0.0])) / torch.tensor([2.0, 1.0, 1.0])
    torch.testing.assert_close(condition[..., -3:], goal)


@torch.inference_mode()
def test_it_steers_by_its_goal(folder: Path) -> None:
    policy = build_policy_of(read_plan(folder, None)).eval()
    image, chunks = torch.zeros(1, *policy.contract.image_shape), []
    for goal_x_m in (0.0, 20.0):
        state = torch.from_numpy(level_state(policy.contract))
        state[..., 13] = goal_x_m
        chunks.append(policy.predict(image, state, torch.zeros(1, 4, 4), 4))
    assert chunks[0].shape == (1, 7, 4)
    assert not torch.allclose(chunks[0], chunks[1])
