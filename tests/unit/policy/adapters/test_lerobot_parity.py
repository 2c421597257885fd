"""Policies that LeRobot's own code wrote: the same actions from the same inputs."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import save_file

from helpers import lerobot_checkpoints as formula
from policy.adapters.lerobot.plan import read_plan
from policy.adapters.lerobot.policy import load_policy_of
from policy.contract import STATE_NAMES
from policy.engines.choose import chunks_of_samples, make_parity_samples
from policy.engines.openvino_modules import ModuleConverter, make_module_runner
from policy.engines.runner import ExecutionSettings
from policy.engines.torch_engines import make_torch_runner
from policy.errors import CheckpointError

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
    # The seed of a camera's images is its place in config.json.
    seeds = policy._policy_cameras
    frames = [formula.images((samples, steps, 3, *size), seeds[at]) for at in range(len(cameras))]
    stacked = np.stack(frames, axis=2).reshape(samples, *contract.image_shape)
    return torch.from_numpy(stacked), torch.from_numpy(
        state.reshape(samples, *contract.state_shape)
    )


def in_contract_units(actions):
    """LeRobot's actions by the contract file."""
    ours = actions * np.array(SCALE, np.float32) + np.array(OFFSET, np.float32)
    return ours[..., [ACTION.index(name) for name in ("throttle", "yaw", "pitch", "roll")]]


@torch.inference_mode()
def test_actions_are_those_of_lerobot(golden):
    case, expected, policy, cameras = golden
    image, state = inputs(policy, expected, cameras)
    if case.startswith("diffusion"):
        shape = policy.initial_noise.shape
        policy.initial_noise.copy_(torch.from_numpy(formula.drawn("noise", tuple(shape))))
    steps = 7 if case == "diffusion_sample" else 4
    actions = policy.predict(image, state, torch.zeros(len(image), 4, 4), steps).numpy()
    wanted = in_contract_units(expected["actions"])
    assert actions.shape == (len(image), policy.contract.horizon, 4)
    # Solves of several steps magnify rounding: 6e-4 where a CPU has no AVX-512.
    atol = 1e-3 if case.startswith("diffusion") else ATOL
    np.testing.assert_allclose(actions, wanted, rtol=1e-4, atol=atol)


@pytest.mark.parametrize("golden", ["act", "diffusion"], indirect=True)
def test_the_openvino_engine_computes_the_same_step_by_step(golden):
    _, _, policy, _ = golden
    settings = ExecutionSettings(name="lerobot", num_diffusion_steps=2)
    converter = ModuleConverter(policy, settings)
    graphs = make_module_runner(converter, policy, settings, "f32", "f32")
    samples = make_parity_samples(policy.contract)
    samples.state[..., STATE_NAMES.index(STATE[12])] = policy._state.shift[12]  # a constant there
    expected = chunks_of_samples(make_torch_runner(policy, settings), samples)
    found = chunks_of_samples(graphs, samples)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-3 * np.abs(expected).max())


def test_weights_of_another_network_are_refused(tmp_path):
    shutil.copytree(GOLDENS / "act", tmp_path, dirs_exist_ok=True)
    weights = formula.weights(tmp_path, dict(np.load(tmp_path / "expected.npz")))
    contract_file(tmp_path, "act", 13)
    sick = {**weights, "model.decoder_pos_embed.weight": np.full((10, 32), np.nan, np.float32)}
    del weights["model.action_head.bias"]
    weights["model.action_head.weight"] = np.zeros((4, 31), np.float32)
    weights["model.nose.weight"] = np.zeros(1, np.float32)
    for wrong, told in (
        (sick, ("NaN", "decoder_pos_embed")),
        (weights, ("3 places", "missing 'action_head.bias'", "is [4, 31], must be", "nose.weight")),
    ):
        save_file(wrong, tmp_path / "model.safetensors")
        with pytest.raises(CheckpointError) as caught:
            load_policy_of(read_plan(tmp_path, None), seed=0, num_diffusion_steps=4)
        assert all(each in str(caught.value) for each in told)
