"""``mavbridge contract`` for ONNX: names and shapes are those of the graphs."""

import tomllib
from pathlib import Path

import pytest

from mavbridge.commands.config import ContractConfig
from mavbridge.commands.contract import contract
from policy.adapters.interface import read_interface
from policy.errors import ContractError

onnx = pytest.importorskip("onnx", reason="the extra onnx writes the graphs")


def graph(path: Path, height: int | str = 96, channels: int = 3) -> Path:
    """Takes what a policy takes, and gives a constant chunk of 8 actions."""
    helper, float32 = onnx.helper, onnx.TensorProto.FLOAT
    shapes = {
        "rgb_front": [1, channels, height, 128],
        "robot_state": [1, 2],
        "action_history": [1, 4, 4],
    }
    inputs = [helper.make_tensor_value_info(name, float32, s) for name, s in shapes.items()]
    chunk = helper.make_tensor("value", float32, [1, 8, 4], [0.0] * 32)
    node = helper.make_node("Constant", [], ["chunk"], value=chunk)
    output = helper.make_tensor_value_info("chunk", float32, [1, 8, 4])
    onnx.save(helper.make_model(helper.make_graph([node], "policy", inputs, [output])), path)
    return path


def test_sizes_are_read_and_the_rest_is_asked(tmp_path: Path) -> None:
    path = graph(tmp_path / "policy.onnx")
    assert contract(path, ContractConfig()) == 0
    draft = tmp_path / "mavbridge.toml"
    read = tomllib.loads(draft.read_text())
    sizes = ("image_height", "image_width", "history_len", "horizon")
    assert [read["contract"][name] for name in sizes] == [96, 128, 4, 8]
    assert read["images"] == {"front": "rgb_front"}
    assert read["state"] == {"key": "robot_state", "names": ["?", "?"]}
    with pytest.raises(ContractError, match=r"5 answers are missing: \[contract\] chunk_dt_s"):
        read_interface(draft)


def test_a_size_that_the_graph_leaves_open_is_asked(tmp_path: Path) -> None:
    graph(tmp_path / "policy.onnx", height="height")
    assert contract(tmp_path, ContractConfig(out=tmp_path / "mine.toml")) == 0
    with pytest.raises(ContractError, match=r"\[contract\] image_height"):
        read_interface(tmp_path / "mine.toml")
