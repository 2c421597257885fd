"""Graphs of other tools: they fly as they are, or are refused in one sentence."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

pytest.importorskip("onnx", reason="the extra onnx writes the graphs")

from onnx import TensorProto, helper

from helpers import foreign_graphs as graphs
from policy.adapters.drafts import onnx_entries
from policy.engines.runner import level_state
from policy.errors import PolicyError
from policy.loading.load import load_policy
from policy.loading.request import PolicyRequest
from policy.protocol import PolicyRunner

Write = Callable[[Path], None]


def load(spec: str) -> PolicyRunner:
    request = PolicyRequest(spec=spec, dual_rate=False)
    return load_policy(request, now_s=lambda: 0.0).runner


def act(runner: PolicyRunner, *, vx_mps: float = 0.0, level: int = 0) -> np.ndarray:
    """First action for a velocity and an evenly grey image."""
    contract = runner.contract
    state = level_state(contract)
    state[0, 0] = vx_mps
    rgb = np.full((contract.image_height, contract.image_width, 3), level, np.uint8)
    history = np.zeros((1, contract.history_len, 4), np.float32)
    return runner.act(runner.join([[runner.encode(rgb)]]), state, history)[0, 0]


def require_counting(runner: PolicyRunner) -> None:
    """Its hidden state goes from call to call until a reset."""
    for _ in range(2):
        throttles = [act(runner)[0] for _ in range(3)]
        assert throttles == pytest.approx([0.1, 0.2, 0.3], abs=1e-3)
        runner.reset()


@pytest.mark.parametrize("state", ["obs", "x.1"])
def test_one_action_for_one_observation_flies_as_it_is(tmp_path: Path, state: str) -> None:
    graphs.write_contract(tmp_path)
    graphs.actor(tmp_path / "policy.onnx", state=state, outputs=("actions", "values", "log_prob"))
    with pytest.raises(PolicyError, match=r"3 outputs \(actions; values; log_prob\).*outputs"):
        load(f"onnx:{tmp_path}")
    graphs.describe(tmp_path, outputs={"chunk": "actions"})
    assert act(load(f"onnx:{tmp_path}"), vx_mps=2.0) == pytest.approx([0.2] * 4, abs=1e-3)


def test_state_and_actions_are_in_the_order_and_units_of_the_contract_file(tmp_path: Path) -> None:
    state = '[state]\nnames = ["vx_mps", "yaw_rad"]\nscale = [3.0, 1.0]\n'
    names = '["roll", "pitch", "yaw", "throttle"]'
    action = f"[action]\nnames = {names}\nscale = [1.0, 1.0, 1.0, 0.5]\n"
    graphs.write_contract(tmp_path, more=state + action)
    graphs.actor(tmp_path / "policy.onnx", state_dim=2)
    sticks = act(load(f"onnx:{tmp_path}"), vx_mps=2.0)
    assert sticks == pytest.approx([0.3, 0.6, 0.6, 0.6], abs=1e-3)


@pytest.mark.parametrize("hidden", [("h_in", "h_out"), ("state_in_0", "state_out_0"), ("h", "hn")])
def test_a_hidden_state_goes_from_call_to_call_until_reset(tmp_path, hidden):
    graphs.write_contract(tmp_path)
    graphs.recurrent(tmp_path / "policy.onnx", hidden=hidden)
    if hidden == ("h", "hn"):
        graphs.describe(tmp_path, hidden={"h": "hn"}, outputs={"chunk": "actions"})
    require_counting(load(f"onnx:{tmp_path}"))


@pytest.mark.parametrize(
    ("kind", "white"), [(TensorProto.FLOAT16, 1.0), (TensorProto.UINT8, 255.0)]
)
def test_the_element_type_says_what_a_pixel_is(tmp_path: Path, kind: int, white: float) -> None:
    graphs.write_contract(tmp_path)
    graphs.image_actor(tmp_path / "policy.onnx", kind=kind)
    runner = load(f"onnx:{tmp_path}")
    for level in (0, 1, 255):
        assert act(runner, level=level) == pytest.approx([white * level / 255] * 4, rel=5e-3)


def external(folder: Path, change: Callable[[Path], object]) -> None:
    graphs.actor(folder / "policy.onnx", external=True)
    change(folder / "policy.onnx.data")


def pointer(path: Path) -> None:
    path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 208\n")


def one_node(
    folder: Path, kind: str, *, weight: np.ndarray | None = None, domain: str = ""
) -> None:
    """Write obs [1, 13] -> one node -> actions."""
    weights = {} if weight is None else {"w": weight}
    graphs.save_graph(
        folder / "policy.onnx",
        [helper.make_node(kind, ["obs", *weights], ["actions"], domain=domain)],
        {"obs": (graphs.FLOAT, (1, 13))},
        {"actions": (graphs.FLOAT, (1, 4 if weight is None else weight.shape[1]))},
        weights,
    )


REFUSED: dict[str, tuple[Write, str]] = {
    "external data missing": (
        lambda folder: external(folder, Path.unlink),
        r"policy\.onnx\.data, .* is missing or cut short: copy both",
    ),
    "external data a pointer": (
        lambda folder: external(folder, pointer),
        r"policy\.onnx\.data, .* is a pointer of Git LFS.*git lfs pull",
    ),
    "integer actions": (
        lambda folder: graphs.actor(folder / "policy.onnx", action_type=TensorProto.INT64),
        r"chunk is of type i64",
    ),
    "integer image": (
        lambda folder: graphs.image_actor(folder / "policy.onnx", kind=TensorProto.INT32),
        r"\['image'\] is of type i32",
    ),
    "state of another width": (
        lambda folder: graphs.actor(folder / "policy.onnx", state_dim=17),
        r"takes \['\[1,17\]'\].*\[1, 13\]",
    ),
    "hidden of another shape": (
        lambda folder: [
            graphs.recurrent(folder / "policy.onnx"),
            graphs.describe(folder, hidden={"h_in": "actions"}),
        ],
        r"h_in is \[1, 1, 3\] and its output actions \[1, 4\]",
    ),
    "no such output": (
        lambda folder: [
            graphs.actor(folder / "policy.onnx"),
            graphs.describe(folder, outputs={"chunk": "action"}),
        ],
        r"no output 'action' \(actions\)",
    ),
    "graph cut": (
        lambda folder: [
            graphs.actor(folder / "policy.onnx"),
            os.truncate(folder / "policy.onnx", 150),
        ],
        r"policy\.onnx cannot be read as ONNX .*copy it again",
    ),
    "operator of a vendor": (
        lambda folder: one_node(folder, "Foo", domain="com.acme"),
        r"policy\.onnx holds what OpenVINO cannot run \(.*com\.acme\.Foo.*ONNX standard",
    ),
    "three actions": (
        lambda folder: one_node(folder, "MatMul", weight=np.zeros((13, 3), np.float32)),
        r"onnx:.*its chunk is \[1, 1, 3\], and its last axis must be the 4 numbers",
    ),
    "not a number": (
        lambda folder: one_node(folder, "MatMul", weight=np.full((13, 4), np.nan, np.float32)),
        r"onnx:.*NaN or infinity",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_unusable_graphs_are_refused_by_cause(tmp_path: Path, case: str) -> None:
    write, told = REFUSED[case]
    graphs.write_contract(tmp_path)
    write(tmp_path)
    with pytest.raises(PolicyError, match=told):
        load(f"onnx:{tmp_path}")


def test_a_draft_has_the_state_whatever_its_input_is_called(tmp_path: Path) -> None:
    graphs.actor(tmp_path / "policy.onnx", state="obs")
    graphs.recurrent(tmp_path / "recurrent.onnx")
    for name in ("policy.onnx", "recurrent.onnx"):
        found = {(each.table, each.name): each.value for each in onnx_entries([tmp_path / name])}
        assert found["state", "key"] == "obs"
        assert found["state", "names"] == ["?"] * 13


def test_torchscript_of_an_observation_alone_flies_and_keeps_its_state(tmp_path: Path) -> None:
    graphs.write_contract(tmp_path)
    path = tmp_path / "policy.pt"
    graphs.save_script(path, graphs.StateActor())
    runner = load(f"torchscript:{path}")
    assert act(runner, vx_mps=2.0) == pytest.approx([0.2] * 4, abs=1e-3)
    graphs.save_script(path, graphs.CountingActor())
    require_counting(load(f"torchscript:{path}"))
    graphs.save_script(path, graphs.TupleActor())
    with pytest.raises(PolicyError, match=r"returns 3 values \(0, 1, 2\).*\"chunk\": 0"):
        load(f"torchscript:{path}")


class Deep(nn.Module):
    """Fails inside of torch."""

    def forward(self, image: Tensor, state: Tensor) -> Tensor:
        """Multiply matrices that do not fit."""
        return torch.matmul(state, torch.zeros(7, 4))


def test_an_error_inside_of_torchscript_is_one_sentence(tmp_path: Path) -> None:
    graphs.write_contract(tmp_path)
    graphs.save_script(tmp_path / "policy.pt", Deep())
    with pytest.raises(PolicyError, match=r"policy\.pt failed on a state: .*13 and 7x4") as refusal:
        load(f"torchscript:{tmp_path / 'policy.pt'}")
    assert "Traceback" not in str(refusal.value)
    assert "\n" not in str(refusal.value)
