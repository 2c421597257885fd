"""Policies that LeRobot's own code wrote: the same actions from the same inputs."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import save_file

from helpers import lerobot_checkpoints as formula
from policy.contract import STATE_NAMES
from policy.foreign.lerobot.load import load_policy_of
from policy.foreign.lerobot.plan import read_plan

GOLDENS = Path(__file__).parents[3] / "data" / "lerobot"
CASES = sorted(path.parent.name for path in GOLDENS.glob("*/config.json"))
ATOL = 5e-5
"""Of actions up to some 20 units, where float32 resolves 2e-6; each torch rounds differently."""
STATE = tuple(reversed(STATE_NAMES))
ACTION = ("roll", "throttle", "pitch", "yaw")
SCALE, OFFSET = (1.0, -2.0, 0.5, 3.0), (0.0, 1.0, -1.0, 0.25)
CAMERAS = {
    "act_two_cameras_pre_norm": ("down", "front"),
    "diffusion_sample": ("down", "front"),
    "diffusion_separate": ("front", "down"),
}
"""Of the contract; in the other order than config.json's."""


def contract_file(folder, case, state_dim):
    cameras = CAMERAS.get(case, ("front",))
    file = folder / "mavbridge.toml"
    file.write_text(
        f"""
        [contract]
        chunk_dt_s = 0.1
        cameras = {list(cameras)}
        [state]
        names = {list(STATE[:state_dim])}
        [action]
        names = {list(ACTION)}
        scale = {list(SCALE)}
        offset = {list(OFFSET)}
        """
    )
    return cameras


@pytest.fixture(scope="module", params=CASES)
def golden(request, tmp_path_factory):
    """(case, expected, the policy that was loaded, cameras of its contract)."""
    case = request.param
    folder = tmp_path_factory.mktemp(case)
    shutil.copytree(GOLDENS / case, folder, dirs_exist_ok=True)
    expected = dict(np.load(folder / "expected.npz"))
    save_file(formula.weights(folder, expected), folder / "model.safetensors")
    cameras = contract_file(folder, case, expected["state"].shape[-1])
    plan = read_plan(folder, None)
    policy, _ = load_policy_of(plan, seed=0, num_diffusion_steps=4)
    yield case, expected, policy, cameras
    shutil.rmtree(folder)


def inputs(policy, expected, cameras):
    """What the loops would give: stacked by the contract, in the contract's order."""
    contract = policy.contract
    samples, steps, state_dim = expected["state"].shape
    state = np.zeros((samples, steps, 13), np.float32)
    state[:, :, [STATE_NAMES.index(name) for name in STATE[:state_dim]]] = expected["state"]
    size = contract.image_height, contract.image_width
    keys = {"front": 0, "down": 1} if policy_order(policy) == "front" else {"down": 0, "front": 1}
    frames = [formula.images((samples, steps, 3, *size), keys[name]) for name in cameras]
    stacked = np.stack(frames, axis=2).reshape(samples, *contract.image_shape)
    return torch.from_numpy(stacked), torch.from_numpy(
        state.reshape(samples, *contract.state_shape)
    )


def policy_order(policy):
    """The camera that comes first in config.json."""
    return policy.contract.cameras[policy._policy_cameras.index(0)]


def in_contract_units(actions):
    """LeRobot's actions by the contract file."""
    ours = actions * np.array(SCALE, np.float32) + np.array(OFFSET, np.float32)
    return ours[..., [ACTION.index(name) for name in ("throttle", "yaw", "pitch", "roll")]]


@torch.inference_mode()
def test_actions_are_those_of_lerobot(golden):
    case, expected, policy, cameras = golden
    image, state = inputs(policy, expected, cameras)
    if case.startswith("diffusion"):
        shape = policy.net.initial_noise.shape
        policy.net.initial_noise.copy_(torch.from_numpy(formula.drawn("noise", tuple(shape))))
    steps = 7 if case == "diffusion_sample" else 4
    actions = policy.predict(image, state, torch.zeros(len(image), 4, 4), steps).numpy()
    wanted = in_contract_units(expected["actions"])
    assert actions.shape == (len(image), policy.contract.horizon, 4)
    np.testing.assert_allclose(actions, wanted, rtol=0, atol=ATOL)
