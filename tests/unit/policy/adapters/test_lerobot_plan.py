"""What a LeRobot folder and a contract file say, and what is refused before weights are read."""

import json
import re
import shutil
from dataclasses import asdict
from functools import reduce
from operator import getitem
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file, save_file
from safetensors.torch import save_file as save_tensors

from policy.adapters.lerobot.plan import read_plan
from policy.errors import CheckpointError, ContractError, PolicyError
from policy.loading.load import check_request, read_policy_contract
from policy.loading.request import PolicyRequest

GOLDENS = Path(__file__).parents[3] / "data" / "lerobot"
STATISTICS = "policy_preprocessor_step_3_normalizer_processor.safetensors"
FRONT = "observation.images.front"
CONTRACT = '[contract]\nchunk_dt_s = 0.1\naction = "velocity"\n'


@pytest.fixture
def folder(tmp_path):
    """Of a diffusion policy of two observations of one camera of 64x96, and 13 numbers of state."""
    shutil.copytree(GOLDENS / "diffusion", tmp_path, dirs_exist_ok=True)
    save_file({"diffusion.unet.final_conv.1.bias": np.zeros(4, np.float32)},
              tmp_path / "model.safetensors")  # fmt: skip
    (tmp_path / "mavbridge.toml").write_text(CONTRACT)
    return tmp_path


def edit(path, change):
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def test_the_contract_has_what_the_files_say(folder, tmp_path_factory):
    contract = read_policy_contract(PolicyRequest(spec=f"lerobot:{folder}"))
    assert (contract.image_height, contract.image_width) == (64, 96)
    assert contract.observation_steps == 2
    assert contract.observation_dt_s == contract.chunk_dt_s == 0.1
    assert contract.horizon == 7, "8 actions, the first of which acts at the older observation"
    assert contract.feature_dim == 8, "two coordinates of 4 keypoints"
    assert contract.action == "velocity"
    assert (contract.image_mean_rgb, contract.image_std_rgb) == ((0, 0, 0), (1, 1, 1))
    act = tmp_path_factory.mktemp("act")
    shutil.copytree(GOLDENS / "act", act, dirs_exist_ok=True)
    save_file({}, act / "model.safetensors")
    contract = read_plan(act, folder / "mavbridge.toml").interface.contract
    assert contract.feature_dim == 32 * 2 * 3, "the cells of its last map"
    assert (contract.horizon, contract.observation_steps) == (10, 1)


CONFIG, INPUTS = ("config.json",), ("config.json", "input_features")
PROCESSOR_STEP = ("policy_preprocessor.json", "steps", 3)


@pytest.mark.parametrize(
    ("place", "change", "said"),
    [
        (CONFIG, {"type": "pi0"}, "type must be one of act, diffusion, got 'pi0'"),
        (
            CONFIG,
            {"prediction_type": "v_prediction"},
            "prediction_type must be one of epsilon, sample",
        ),
        (CONFIG, {"use_group_norm": None}, "no entry 'use_group_norm', and its default differs"),
        (CONFIG, {"down_dims": [16, 32, 64, 128]}, "a horizon of 8 does not suit"),
        (CONFIG, {"down_dims": []}, "down_dims must be positive integers"),
        (CONFIG, {"crop_shape": [65, 65]}, "cannot crop"),
        (CONFIG, {"num_train_timesteps": 10**9}, "num_train_timesteps must be at most 10000"),
        (CONFIG, {"kernel_size": True}, "kernel_size must be a positive integer"),
        (CONFIG, {"clip_sample": 1}, "clip_sample must be true or false"),
        (CONFIG, {"use_peft": True}, "merge"),
        (CONFIG, {"input_features": {}}, "images must be of one shape"),
        (
            *(CONFIG, {"output_features": {"action": {"type": "ACTION", "shape": [6]}}}),
            "its action has the shape [6]",
        ),
        (INPUTS, {"observation.wind": {"type": "ENV", "shape": [4]}}, "observation.wind"),
        (INPUTS, {"observation.goal": {"type": "GOAL", "shape": [3]}}, "observation.goal"),
        (PROCESSOR_STEP, {"config": None}, "malformed entries ['config']"),
        (PROCESSOR_STEP, {"state_file": 3}, "malformed entries ['state_file']"),
        (
            *(PROCESSOR_STEP, {"config": {"eps": "x", "norm_map": []}}),
            "malformed entries ['norm_map', 'eps']",
        ),
        (
            *(PROCESSOR_STEP, {"config": {"norm_map": {"STATE": ["a"]}}}),
            "normalises observation.state by \"['a']\"",
        ),
    ],
)
def test_files_that_are_not_supported_are_refused(folder, place, change, said):
    name, *keys = place
    edit(folder / name, lambda data: reduce(getitem, keys, data).update(change))
    with pytest.raises(CheckpointError, match=re.escape(said)):
        read_plan(folder, None)


def test_doubtful_entries_are_warnings(folder):
    edit(folder / "config.json", lambda data: data.update(use_new_trick=True))
    notes = read_plan(folder, None).notes
    assert any("use_new_trick" in note for note in notes)
    assert any("numbers [12]" in note for note in notes)  # never changed in training


def test_entries_that_older_versions_lack_or_that_are_null_have_the_value_of_then(folder):
    def older(data):
        for name in ("resize_shape", "crop_ratio", "compile_model", "compile_mode", "use_peft"):
            del data[name]

    def empty(data):
        data["steps"][0]["config"] = {"rename_map": None}
        data["steps"][3]["config"]["eps"] = None

    before = read_plan(folder, None)
    edit(folder / "config.json", older)
    edit(folder / "policy_preprocessor.json", empty)
    after = read_plan(folder, None)
    assert after.config == before.config
    np.testing.assert_equal(asdict(after.normalisation), asdict(before.normalisation))


def test_a_folder_above_is_told_from_one_that_holds_nothing(folder, tmp_path):
    below = tmp_path / "run" / "checkpoints" / "last" / "pretrained_model"
    below.mkdir(parents=True)
    (below / "config.json").write_text("{}")
    with pytest.raises(CheckpointError, match=r"last/pretrained_model does: name that one"):
        read_plan(tmp_path / "run", None)
    with pytest.raises(CheckpointError, match="usually"):
        read_plan(tmp_path / "nowhere", None)


@pytest.mark.parametrize(
    ("file", "said"),
    [
        ("model.safetensors", "copy the whole folder"),
        ("policy_postprocessor.json", "No such file"),
        (STATISTICS, "is missing"),
        ("mavbridge.toml", "mavbridge contract"),
    ],
)
def test_a_missing_file_is_named(folder, file, said):
    (folder / file).unlink()
    with pytest.raises(PolicyError, match=said) as caught:
        check_request(PolicyRequest(spec=f"lerobot:{folder}"))
    assert file in str(caught.value)


@pytest.mark.parametrize(
    ("contract", "said"),
    [
        ("image_height = 224", "image_height = 224 contradicts .* 64"),
        ("prefix_len = 3", "prefix_len = 3 contradicts .* 0"),
        ("observation_dt_s = 0.5", "observations are chunk_dt_s = 0.1 apart"),
        ("horizon = 16", "horizon = 16 contradicts .* 7"),
        ('cameras = ["front", "down"]', r"policy's images are \['observation.images.front'\]"),
        ('[state]\nnames = ["vx_mps", "qw"]', "takes a state of 13 numbers, and these are 2"),
        ('[state]\nkey = "state"', "LeRobot's is 'observation.state'"),
        ('[images]\nfront = "observation.images.nose"', "name all cameras"),
    ],
)
def test_a_contract_that_contradicts_the_policy_is_refused(folder, contract, said):
    (folder / "mavbridge.toml").write_text(CONTRACT + contract + "\n")
    with pytest.raises(ContractError, match=said):
        read_plan(folder, None)


def test_a_renamed_camera_is_known_by_both_names(folder):
    def rename(data):
        data["steps"][0]["config"]["rename_map"] = {"observation.images.nose": FRONT}

    edit(folder / "policy_preprocessor.json", rename)
    for key in ("observation.images.nose", FRONT):
        (folder / "mavbridge.toml").write_text(f'{CONTRACT}[images]\nfront = "{key}"\n')
        assert read_plan(folder, None).policy_cameras == (0,)


def test_processors_that_are_not_supported_are_refused(folder):
    path = folder / STATISTICS
    save_file({k: v for k, v in load_file(path).items() if not k.endswith("state.max")}, path)
    with pytest.raises(CheckpointError, match=r"observation.state is normalised by MIN_MAX.*'max'"):
        read_plan(folder, None)
    for key, size in (
        ("observation.state.min", 1),
        ("observation.state.min", 14),
        (FRONT + ".mean", 1),
    ):
        shutil.copy(GOLDENS / "diffusion" / STATISTICS, path)
        save_file(load_file(path) | {key: np.zeros(size, np.float32)}, path)
        with pytest.raises(CheckpointError, match=rf"must have \d+ numbers, got .*: {size}"):
            read_plan(folder, None)
    # NumPy has bfloat16 where another package adds it, and no float8.
    save_tensors({"observation.state.min": torch.zeros(13).to(torch.float8_e4m3fn)}, path)
    with pytest.raises(CheckpointError, match=r"of a type that numpy lacks .*: save them as fl"):
        read_plan(folder, None)
    shutil.copy(GOLDENS / "diffusion" / STATISTICS, path)
    step = {"registry_name": "relative_actions_processor", "config": {}}
    edit(folder / "policy_preprocessor.json", lambda data: data["steps"].append(step))
    with pytest.raises(CheckpointError, match="relative_actions_processor"):
        read_plan(folder, None)
