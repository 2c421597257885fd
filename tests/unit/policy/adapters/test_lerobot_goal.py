"""Diffusion policies of LeRobot that fly to a goal, with and without a camera."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file, save_file

from helpers.lerobot_checkpoints import SHAPES_FILE, weight
from policy.adapters.lerobot.config import ENVIRONMENT_KEY
from policy.adapters.lerobot.plan import read_plan
from policy.adapters.lerobot.policy import LeRobotDiffusion, build_policy_of
from policy.engines.runner import level_state
from policy.loading.load import load_policy
from policy.loading.request import PolicyRequest

GOLDENS = Path(__file__).parents[3] / "data" / "lerobot"
STATISTICS = "policy_preprocessor_step_3_normalizer_processor.safetensors"


@pytest.fixture(params=["with a camera", "without"])
def folder(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """The kept diffusion policy with a goal as its environment; its weights drawn by name."""
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
    policy = build_policy_of(read_plan(tmp_path, None))
    shapes = json.loads((tmp_path / SHAPES_FILE).read_text())
    prefix, ours = policy.net.prefix, policy.net.state_dict()
    owns = {name: policy.net.own_name(name.removeprefix(prefix)) or "" for name in shapes}
    drawn = {n: weight(n, tuple(ours[own].shape)) for n, own in owns.items() if own in ours}
    save_file(drawn, tmp_path / "model.safetensors")
    return tmp_path


def test_the_condition_is_state_images_environment_as_in_lerobot(folder: Path) -> None:
    policy = build_policy_of(read_plan(folder, None))
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


def test_it_is_loaded_and_steers_by_its_goal(folder: Path) -> None:
    request = PolicyRequest(spec=f"lerobot:{folder}", num_diffusion_steps=4, engine="torch")
    runner = load_policy(request, now_s=lambda: 0.0).runner
    contract = runner.contract
    rgb = np.zeros((contract.image_height, contract.image_width, 3), np.uint8)
    encoded = runner.join([[runner.encode(rgb)]] * contract.observation_steps)
    history = np.zeros((1, contract.history_len, 4), np.float32)
    chunks = []
    for goal_x_m in (0.0, 20.0):
        state = level_state(contract)
        state[..., 13] = goal_x_m
        chunks.append(runner.act(encoded, state, history))
    assert chunks[0].shape == (1, 7, 4)
    assert not np.allclose(chunks[0], chunks[1])
