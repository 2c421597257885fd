"""``mavbridge contract``: drafts from LeRobot's folders, and from the graphs of ONNX files."""

import json
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from helpers.status import status_of, told_by
from policy.adapters.interface import ACTION_FIELDS, read_interface
from policy.contract import ACTION_NAMES, Contract
from policy.errors import ContractError

CAMERA = "observation.images.front"


def write_json(path: Path, document: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(document))
    return path


def dataset(
    folder: Path,
    state: Sequence[str] | dict[str, Any] | None,
    action: Sequence[str] | None = ACTION_NAMES,
    cameras: Sequence[str] = (CAMERA,),
    state_dim: int = 3,
    az_mps2: float | None = None,
) -> Path:
    """A foreign dataset's meta; without our note about axes."""
    features = {
        "observation.state": {"dtype": "float32", "shape": [state_dim], "names": state},
        "action": {"dtype": "float32", "shape": [4], "names": action},
        **{key: {"dtype": "video", "shape": [96, 96, 3]} for key in cameras},
        "timestamp": {"dtype": "float32", "shape": [1]},
    }
    write_json(folder / "meta/info.json", {"fps": 20, "features": features})
    if az_mps2 is not None:
        mean = [0.0] * (state_dim - 1) + [az_mps2]
        write_json(folder / "meta/stats.json", {"observation.state": {"mean": mean}})
    return folder


def checkpoint(folder: Path, state_dim: int = 3, action_dim: int = 4) -> Path:
    inputs = {
        CAMERA: {"type": "VISUAL", "shape": [3, 96, 96]},
        "observation.state": {"type": "STATE", "shape": [state_dim]},
    }
    outputs = {"action": {"type": "ACTION", "shape": [action_dim]}}
    config = {"type": "act", "input_features": inputs, "output_features": outputs}
    write_json(folder / "config.json", config)
    return folder


def draft(source: Path, *options: str) -> Path:
    assert status_of("contract", source, *options) == 0
    return source / "mavbridge.toml"


def test_a_policy_alone_leaves_the_answers_to_the_user(tmp_path: Path) -> None:
    checkpoint(tmp_path)
    status, said = told_by("contract", f"lerobot:{tmp_path}")  # as for --policy
    assert status == 0
    path = tmp_path / "mavbridge.toml"
    with pytest.raises(ContractError) as refused:
        read_interface(path)
    missing = "chunk_dt_s, [contract] state_frame, [contract] action, [state] names, [action] names"
    assert f"5 answers are missing: [contract] {missing}" in str(refused.value)
    assert "please answer: [contract] chunk_dt_s" in said
    assert "--dataset" in said


def test_a_draft_with_all_answers_is_read(tmp_path: Path) -> None:
    path = draft(checkpoint(tmp_path))
    answers = {
        'chunk_dt_s = "?"': "chunk_dt_s = 0.1",
        'state_frame = "?"': 'state_frame = "enu_flu"',
        'action = "?"': 'action = "velocity"',
        'names = ["?", "?", "?"]': 'names = ["yaw_rad", "vx_mps", "vy_mps"]',
        'names = ["?", "?", "?", "?"]': 'names = ["yaw_rate_radps", "vx_mps", "vy_mps", "vz_mps"]',
        "# scale = [1.0, 1.0, 1.0]": "scale = [57.3, 1.0, 1.0]",
        "# scale = [1.0, 1.0, 1.0, 1.0]": "scale = [0.01745, 1.0, 1.0, 1.0]",
    }
    lines = path.read_text().splitlines()
    assert not set(answers) - set(lines)
    path.write_text("\n".join(answers.get(line, line) for line in lines))
    interface = read_interface(path)
    assert interface.contract.chunk_dt_s == 0.1
    assert (interface.contract.state_frame, interface.contract.action) == ("enu_flu", "velocity")
    assert interface.state_names == ("yaw_rad", "vx_mps", "vy_mps")
    assert interface.state_scale == (57.3, 1.0, 1.0)
    assert interface.action_scale == (0.01745, 1.0, 1.0, 1.0)
    assert interface.camera_keys == (CAMERA,)


def test_names_are_guessed_by_their_spelling_and_marked(tmp_path: Path) -> None:
    path = draft(dataset(tmp_path, ["Vel_X", "vy", "acc_z"], az_mps2=9.8))
    assert tomllib.loads(path.read_text())["state"]["names"] == ["vx_mps", "vy_mps", "az_mps2"]
    text = " ".join(line.removeprefix("# ") for line in path.read_text().splitlines())
    assert "GUESSED: the dataset's meta/info.json calls them Vel_X, vy, acc_z" in text


@pytest.mark.parametrize(
    ("names", "term"), [(ACTION_NAMES, "full_lean_deg"), (ACTION_FIELDS["rates"], "hover_thrust")]
)
def test_gains_that_no_dataset_tells_are_guesses_to_check(
    tmp_path: Path, names: Sequence[str], term: str
) -> None:
    status, said = told_by("contract", dataset(tmp_path, ["vx", "vy", "vz"], names))
    assert status == 0
    assert term in said[said.index("please check: ") :].splitlines()[0]
    written = tomllib.loads((tmp_path / "mavbridge.toml").read_text())["contract"]
    assert written[term] == getattr(Contract(), term)


@pytest.mark.parametrize("state", [["vx", "battery", "vz"], None, ["vx"]])
def test_one_unknown_name_leaves_the_names_to_the_user(
    tmp_path: Path, state: Sequence[str] | None
) -> None:
    path = draft(dataset(tmp_path, state))
    with pytest.raises(ContractError, match=r"missing: \[contract\] state_frame, \[state\] names"):
        read_interface(path)


@pytest.mark.parametrize(
    ("names", "keys"),
    [
        (["down", "front"], ("observation.images.down", "observation.images.front")),
        (["camera_0", "camera_1"], ("left.rgb", "right.rgb")),
        (["camera_0", "camera_1"], ("höhe", "\N{HELICOPTER}")),
    ],
)
def test_cameras_are_called_by_the_ends_of_their_keys_or_numbered(
    tmp_path: Path, names: list[str], keys: tuple[str, str]
) -> None:
    read = tomllib.loads(draft(dataset(tmp_path, None, cameras=keys[::-1])).read_text())
    assert read["contract"]["cameras"] == names
    assert read["images"] == dict(zip(names, keys, strict=True))


def test_the_dataset_that_training_noted_is_found(tmp_path: Path) -> None:
    names = ("vx_mps", "vy_mps", "az_mps2")
    data = dataset(tmp_path / "data", {"motors": [*names]}, az_mps2=-9.7)
    policy = checkpoint(tmp_path / "policy")
    write_json(policy / "train_config.json", {"dataset": {"root": str(data), "repo_id": "a/b"}})
    assert f"its dataset is {data}" in told_by("contract", policy)[1]
    path = policy / "mavbridge.toml"
    interface = read_interface(path)
    assert interface.contract.chunk_dt_s == 0.05
    assert (interface.contract.state_frame, interface.contract.action) == ("ned_frd", "sticks")
    assert interface.state_names == names
    assert "# GUESSED: the mean of az_mps2 is -9.7" in path.read_text()


def test_the_file_beside_the_dataset_is_taken_as_it_is(tmp_path: Path) -> None:
    data = dataset(tmp_path / "data", None)
    (data / "mavbridge.toml").write_text("[contract]\nchunk_dt_s = 0.02\n")
    path = draft(checkpoint(tmp_path / "policy"), "--dataset", str(data))
    assert path.read_text() == (data / "mavbridge.toml").read_text()
    (data / "mavbridge.toml").write_text("[contract\n")
    policy = checkpoint(tmp_path / "other")
    status, said = told_by("contract", policy, "--dataset", data)
    assert (status, (policy / "mavbridge.toml").exists()) == (2, False)
    assert "mavbridge.toml cannot be copied: Expected ']'" in said


def test_the_datasets_state_must_be_the_policys(tmp_path: Path) -> None:
    policy = checkpoint(tmp_path / "policy", state_dim=5)
    data = dataset(tmp_path / "data", ["vx_mps", "vy_mps", "az_mps2"], az_mps2=-9.0)
    path = draft(policy, "--dataset", str(data))
    with pytest.raises(ContractError, match=r"\[state\] names"):
        read_interface(path)
    assert status_of("contract", policy, "--dataset", tmp_path, "--out", tmp_path / "a") == 2


@pytest.mark.parametrize(
    ("prepare", "said"),
    [
        (lambda folder: checkpoint(folder, action_dim=6), "its action has 6 numbers, but 4 fly"),
        (lambda folder: write_json(folder / "config.json", {}), "input_features must be"),
        (lambda folder: write_json(folder / "config.json", []), "not a JSON object"),
        (lambda folder: dataset(folder, None, state_dim=10**30), "must have 1 to 1000 numbers"),
        (
            lambda folder: (checkpoint(folder) / "mavbridge.toml").write_text("mine"),
            "is there already",
        ),
        (
            lambda folder: (checkpoint(folder) / "mavbridge.toml").symlink_to("../victim"),
            "is there already",
        ),
        (
            lambda folder: (folder.mkdir(), graph(folder / "policy.onnx", channels_last=True)),
            "input rgb_front of policy.onnx has its channels last",
        ),
    ],
)
def test_what_cannot_be_drafted_is_refused_and_nothing_is_written(
    tmp_path: Path, prepare: Any, said: str
) -> None:
    folder = tmp_path / "source"
    prepare(folder)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    status, text = told_by("contract", folder)
    assert (status, said in text) == (2, True), text
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def graph(path: Path, height: int | str = 96, *, channels_last: bool = False) -> Path:
    """Takes what a policy takes, and gives a constant chunk of 8 actions."""
    onnx = pytest.importorskip("onnx", reason="the extra onnx writes the graphs")
    image = f"{height}, 128, 3" if channels_last else f"3, {height}, 128"
    text = f"""<ir_version: 9, opset_import: ["" : 18]> policy (
        float[1, {image}] rgb_front, float[1, 2] robot_state, float[1, 4, 4] action_history,
        float[1, 8, 1, 1] feature
    ) => (float[1, 8, 4] chunk) {{ chunk = ConstantOfShape (shape) }}"""
    model = onnx.parser.parse_model(text)
    model.graph.initializer.append(onnx.helper.make_tensor("shape", 7, [3], [1, 8, 4]))
    onnx.save(model, path)
    return path


def test_sizes_of_graphs_are_read_and_the_rest_is_asked(tmp_path: Path) -> None:
    assert status_of("contract", graph(tmp_path / "policy.onnx")) == 0
    path = tmp_path / "mavbridge.toml"
    read = tomllib.loads(path.read_text())
    sizes = ("image_height", "image_width", "history_len", "horizon")
    assert [read["contract"][name] for name in sizes] == [96, 128, 4, 8]
    assert read["images"] == {"front": "rgb_front"}
    assert read["state"] == {"key": "robot_state", "names": ["?", "?"]}
    with pytest.raises(ContractError, match=r"5 answers are missing: \[contract\] chunk_dt_s"):
        read_interface(path)


def test_a_size_that_the_graph_leaves_open_is_asked(tmp_path: Path) -> None:
    graph(tmp_path / "policy.onnx", height="height")
    assert status_of("contract", tmp_path, "--out", tmp_path / "mine.toml") == 0
    with pytest.raises(ContractError, match=r"\[contract\] image_height"):
        read_interface(tmp_path / "mine.toml")
