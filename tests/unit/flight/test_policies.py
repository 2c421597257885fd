import sys
from pathlib import Path

import numpy as np
import pytest

from mavbridge.config.flight import CameraConfig, FlyConfig
from mavbridge.config.policy import PolicyConfig
from mavbridge.core.clock import MonotonicClock
from mavbridge.core.errors import CameraError, UserError
from mavbridge.flight.policies import (
    load_configured_policy,
    load_for_episodes,
    looks_at_images,
    policy_files,
    policy_request,
    require_cameras,
    require_images,
)
from policy.engines.runner import dummy_sample, encode_all
from policy.loading.load import check_request

MINE = """
import numpy as np
from policy.contract import Contract


class Still:
    contract = Contract(arrays="numpy")

    def predict(self, image, state, action_history, num_diffusion_steps):
        return np.zeros((1, self.contract.horizon, 4), np.float32)
"""

DRAWING = """
import numpy as np
import torch
from policy.contract import Contract


class Drawing:
    contract = Contract()

    def __init__(self):
        self.bias = float(np.random.rand())

    def predict(self, image, state, action_history, num_diffusion_steps):
        return torch.rand(1, self.contract.horizon, 4) * self.bias
"""


def test_random_numbers_of_a_policy_depend_on_the_episode_and_on_none_before_it(
    tmp_path: Path,
) -> None:
    path = tmp_path / "drawing.py"
    path.write_text(DRAWING)
    wanted = PolicyConfig(policy=f"{path}:Drawing")

    def first_chunk(seed: int) -> np.ndarray:
        runner = load_for_episodes(wanted, MonotonicClock(), seed).runner
        images, state, history = dummy_sample(runner.contract)
        return runner.act(encode_all(runner, images), state, history)

    alone = first_chunk(7)
    assert not np.array_equal(first_chunk(8), alone)
    np.testing.assert_array_equal(first_chunk(7), alone)


def test_a_users_class_is_found_in_the_working_directory_by_check_and_loading(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An installed command does not have the working directory on its path, ``python -m`` does."""
    (tmp_path / "still_module.py").write_text(MINE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry])
    wanted = PolicyConfig(policy="still_module:Still")
    check_request(policy_request(wanted))
    assert load_configured_policy(wanted, MonotonicClock()).runner.name == wanted.policy


@pytest.mark.parametrize(
    ("policy", "camera", "looks"),
    [
        ("mine:Still", "shm:fpv", True),
        ("mine:Still", "none", False),
        ("onnx:folder", "none", False),
        ("scripted:square", "none", False),
        ("toge", "none", True),
        ("scripted:square", "shm:fpv", False),
    ],
)
def test_black_frames_are_no_fault_of_a_policy_that_is_flown_without_a_camera(
    policy: str, camera: str, looks: bool
) -> None:
    config = FlyConfig(policy=PolicyConfig(policy=policy), camera=CameraConfig(camera=(camera,)))
    assert looks_at_images(config) is looks
    if not looks:
        require_images(config)


@pytest.mark.parametrize("policy", ["toge", "toge:medium"])
def test_a_net_of_ours_is_not_flown_without_a_camera(policy: str) -> None:
    blind = CameraConfig(camera=("none",))
    with pytest.raises(UserError, match="name a camera"):
        require_images(FlyConfig(policy=PolicyConfig(policy=policy), camera=blind))


def test_the_files_of_a_policy_are_those_that_make_it(tmp_path: Path) -> None:
    for name in ("model.safetensors", "config.json", "README.md"):
        (tmp_path / name).write_text("")
    mine, contract = tmp_path / "mine.py", tmp_path / "contract.toml"
    mine.write_text("")
    folder = PolicyConfig(policy=f"lerobot:{tmp_path}", contract=contract)
    assert {path.name for path in policy_files(folder)} == {
        *("contract.toml", "model.safetensors", "config.json"),
    }
    assert policy_files(PolicyConfig(policy=f"{mine}:Mine")) == [mine]
    assert policy_files(PolicyConfig(checkpoint=mine)) == [mine]
    assert [path.name for path in policy_files(PolicyConfig())] == ["toge.safetensors"]
    for nothing in ("scripted:hover", "ws://127.0.0.1:8000", "my_module:Mine"):
        assert policy_files(PolicyConfig(policy=nothing)) == []


@pytest.mark.parametrize(("policy", "is_hinted"), [("scripted:hover", True), ("toge", False)])
def test_a_camera_that_is_not_there_is_needed_only_by_who_looks(
    policy: str, is_hinted: bool
) -> None:
    camera = CameraConfig(camera=("/dev/video987",))
    with pytest.raises(CameraError, match="not there") as caught:
        require_cameras(FlyConfig(policy=PolicyConfig(policy=policy), camera=camera))
    assert ("--camera none" in str(caught.value)) is is_hinted


@pytest.mark.parametrize("policy", ["onnx:{}/a.onnx", "torchscript:{}/a.pt"])
def test_what_is_read_beside_one_file_belongs_to_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, policy: str
) -> None:
    """Otherwise --resume mixes flights by other weights or another contract."""

    def unlisted(_: Path) -> None:
        raise PermissionError

    monkeypatch.setattr(Path, "iterdir", unlisted)  # a folder that may only be entered
    weights = [f"a.{kind}{end}" for kind in ("onnx", "pt") for end in ("", ".data", "_data")]
    for name in (*weights, "policy.json", "mavbridge.toml", "b.onnx", "b.onnx.data", "b.pt"):
        (tmp_path / name).write_text("")
    one = policy.partition("/")[2]
    found = [path.name for path in policy_files(PolicyConfig(policy=policy.format(tmp_path)))]
    assert found == [one, f"{one}.data", f"{one}_data", "mavbridge.toml", "policy.json"]


def test_a_folder_of_graphs_is_known_by_their_weights_too(tmp_path: Path) -> None:
    names = ["head.onnx", "head.onnx.data", "head.onnx_data"]
    for name in (*names, "notes.txt"):
        (tmp_path / name).write_text("")
    found = policy_files(PolicyConfig(policy=f"onnx:{tmp_path}"))
    assert [path.name for path in found] == names
