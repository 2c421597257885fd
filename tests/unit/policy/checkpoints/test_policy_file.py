import json
import os
import pickle
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import nn

from policy.checkpoints.policy_file import (
    build_policy,
    load_checkpoint,
    save_checkpoint,
)
from policy.contract import Contract
from policy.errors import CheckpointError
from policy.nets.diffusion import NoiseSchedule
from policy.nets.resnet_unet import ResnetUnetConfig
from policy.nets.toge import Toge, TogeConfig


@pytest.fixture(scope="module")
def saved(small_toge: Toge, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A good checkpoint; not to be changed by a test."""
    path = tmp_path_factory.mktemp("checkpoint") / "toge.safetensors"
    save_checkpoint(path, small_toge)
    return path


def header_of(path: Path) -> dict[str, str]:
    with safe_open(path, framework="pt") as file:
        return dict(file.metadata())


def with_header(path: Path, header: dict[str, str]) -> Path:
    """A file with this header and next to no weights: the header is looked at first."""
    save_file({"weight": torch.zeros(1)}, path, metadata=header)
    return path


def test_the_file_alone_says_what_it_is(tmp_path: Path) -> None:
    config = TogeConfig(
        size="small",
        backbone="resnet18",
        contract=Contract(
            image_height=32, image_width=48, state_frame="enu_flu", horizon=8, since_exposure=True
        ),
        schedule=NoiseSchedule(prediction="epsilon", betas="linear", num_train_timesteps=50),
    )
    policy = build_policy(config).eval()
    path = tmp_path / "a.safetensors"
    save_checkpoint(path, policy)
    loaded = load_checkpoint(path, fallback=TogeConfig())
    assert loaded.config == policy.config
    assert not loaded.training
    for name, value in policy.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], value), name
    assert [p.name for p in tmp_path.iterdir()] == ["a.safetensors"]


def contents_of(path: Path) -> dict[str, torch.Tensor]:
    with safe_open(path, framework="pt") as file:
        return {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118


def test_a_test_vector_is_carried_and_kept(small_toge: Toge, saved: Path) -> None:
    contents = contents_of(saved)
    assert contents["test_vector.rgb"].shape == (4, 32, 32, 3)
    assert contents["test_vector.chunks"].shape == (4, 16, 4)
    assert contents["test_vector.chunks"].abs().max() > 0.1
    loaded = load_checkpoint(saved, fallback=small_toge.config)
    assert not any(name.startswith("test_vector") for name in loaded.state_dict())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"test_vector.chunks": lambda x: x + 0.02}, r"off by 0\.02.*damaged"),
        ({"test_vector.rgb": lambda x: x.float()}, "test vector is damaged: an image must be"),
        ({"test_vector.state": lambda x: x[:, :12]}, "test vector is damaged: state must be"),
        ({"test_vector.history": lambda x: None}, "test vector is damaged: it must hold"),
        ({"head.unet.out.weight": lambda x: -x}, "do not make the sticks that they made"),
    ],
)
def test_weights_that_do_not_make_their_vector(small_toge, saved, tmp_path, changes, message):
    contents = contents_of(saved)
    for name, change in changes.items():
        changed = change(contents.pop(name))
        if changed is not None:
            contents[name] = changed.contiguous()
    path = tmp_path / "a.safetensors"
    save_file(contents, path, metadata=header_of(saved))
    with pytest.raises(CheckpointError, match=message):
        load_checkpoint(path, fallback=small_toge.config)


class Malicious:
    """Runs a program when unpickled."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.marker),)


@pytest.mark.parametrize("protocol", [None, 0, 2, 4])
def test_a_malicious_pickle_is_refused_and_not_run(small_toge, tmp_path, protocol):
    marker, path = tmp_path / "ran", tmp_path / "a.pt"
    content = {"state_dict": {"weight": Malicious(marker)}}
    if protocol is None:
        torch.save(content, path)
    else:
        path.write_bytes(pickle.dumps(content, protocol=protocol))
    with pytest.raises(CheckpointError, match="could run any program"):
        load_checkpoint(path, fallback=small_toge.config)
    assert not marker.exists()


@pytest.mark.parametrize("zipped", [True, False])
def test_a_pickled_network_is_named_with_its_ways_to_fly(small_toge, tmp_path, zipped):
    path = tmp_path / "a.pt"
    torch.save(nn.Linear(2, 2), path, _use_new_zipfile_serialization=zipped)
    with pytest.raises(CheckpointError, match=r"holds a torch\.nn.*--policy torchscript:FILE"):
        load_checkpoint(path, fallback=small_toge.config)


def test_a_torch_file_with_a_contract_is_refused_and_not_flown_by_another(
    small_toge: Toge, tmp_path: Path
) -> None:
    path = tmp_path / "own.pt"
    torch.save({"state_dict": small_toge.state_dict(), "contract": "{}"}, path)
    with pytest.raises(CheckpointError, match="holds a contract"):
        load_checkpoint(path, fallback=small_toge.config)


def test_a_missing_file_names_what_is_there(small_toge: Toge, saved: Path) -> None:
    with pytest.raises(CheckpointError, match=r"no such file.*toge\.safetensors"):
        load_checkpoint(saved.with_name("other.pt"), fallback=small_toge.config)
    with pytest.raises(CheckpointError, match=r"\.safetensors, \.pt, \.pth"):
        load_checkpoint(saved.with_suffix(".onnx"), fallback=small_toge.config)


def test_nan_weights_are_refused_on_both_ways(small_toge, saved, tmp_path):
    path = tmp_path / "a.safetensors"
    poisoned = {"fine": torch.zeros(2), "fusion.mlp.0.weight": torch.tensor([1.0, float("nan")])}
    save_file(poisoned, path, metadata=header_of(saved))
    with pytest.raises(CheckpointError, match=r"NaN.*fusion\.mlp\.0\.weight"):
        load_checkpoint(path, fallback=small_toge.config)
    policy = build_policy(small_toge.config)
    with torch.no_grad():
        policy.head.unet.out.weight[0, 0] = float("inf")
    with pytest.raises(CheckpointError, match=r"head\.unet\.out\.weight"):
        save_checkpoint(path, policy)


@pytest.mark.parametrize(
    ("name", "tensor", "message"),
    [
        ("fusion.mlp.0.bias", None, r"missing 'fusion\.mlp\.0\.bias'"),
        ("surprise", torch.zeros(3), "unexpected 'surprise'"),
        ("fusion.mlp.0.bias", torch.zeros(3, 7), r"is \[3, 7\], must be \[512\]"),
    ],
)
def test_weights_that_do_not_fit_are_named(small_toge, tmp_path, name, tensor, message):
    state = {**small_toge.state_dict(), name: tensor}
    path = tmp_path / "a.pt"
    torch.save({key: value for key, value in state.items() if value is not None}, path)
    with pytest.raises(CheckpointError, match=message):
        load_checkpoint(path, fallback=small_toge.config)


@pytest.mark.parametrize(
    ("key", "changes", "message"),
    [
        ("contract", {"version": 9}, "version 9 is not supported"),
        ("contract", {"feature_dim": 384}, "feature_dim 384"),
        ("contract", {"unknown": 1}, "unknown contract keys"),
        ("architecture", {"size": "huge"}, "size 'huge' is unknown"),
        ("architecture", {"backbone": "vgg16"}, "backbone 'vgg16' is unknown"),
        ("architecture", {"policy": "other"}, "policy 'other' is unknown"),
        ("architecture", {"depth": 3}, "malformed architecture"),
        ("architecture", {"schedule": {"betas": "quadratic"}}, "betas 'quadratic' is unknown"),
    ],
)
def test_headers_of_another_build_are_refused(saved, tmp_path, key, changes, message):
    header = header_of(saved)
    header[key] = json.dumps({**json.loads(header[key]), **changes})
    path = with_header(tmp_path / "a.safetensors", header)
    with pytest.raises(CheckpointError, match=message) as caught:
        load_checkpoint(path, fallback=TogeConfig())
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("text", ["[" * 100_000, "null", "[]", "{"])
@pytest.mark.parametrize("key", ["contract", "architecture"])
def test_header_text_that_is_nonsense_is_refused(saved, tmp_path, key, text):
    path = with_header(tmp_path / "a.safetensors", {**header_of(saved), key: text})
    with pytest.raises(CheckpointError, match=r"a\.safetensors"):
        load_checkpoint(path, fallback=TogeConfig())


@pytest.mark.parametrize("key", ["contract", "architecture"])
def test_a_file_without_header_says_how_to_convert_it(saved, tmp_path, key):
    header = header_of(saved)
    del header[key]
    path = with_header(tmp_path / "a.safetensors", header)
    with pytest.raises(CheckpointError, match="save_checkpoint"):
        load_checkpoint(path, fallback=TogeConfig())


def test_another_kind_of_policy_is_refused(saved: Path) -> None:
    with pytest.raises(CheckpointError, match="--policy toge"):
        load_checkpoint(saved, fallback=ResnetUnetConfig())
