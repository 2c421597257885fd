"""Policies in ONNX files, and ours written as such."""

import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from helpers.torch_policies import (
    DUAL,
    SINGLE,
    WIDE,
    ForwardOnly,
    TwoRates,
    Wide,
    loaded,
    require_same,
)
from policy.adapters.export import export_onnx, export_torchscript
from policy.adapters.onnx import GraphFile, Wanted
from policy.engines import choose
from policy.engines.runner import ExecutionSettings
from policy.engines.torch_eager import make_torch_runner
from policy.errors import PolicyError
from policy.loading.load import check_request, read_policy_contract
from policy.loading.request import PolicyRequest
from policy.nets.toge import Toge

STEPS = 4


@pytest.fixture(scope="module")
def exported_toge(trained_toge: Toge, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("toge")
    export_onnx(trained_toge, folder)
    export_torchscript(trained_toge, folder / "toge.pt")
    return folder


@pytest.mark.parametrize(
    ("form", "dual_rate"), [("onnx:{}", True), ("onnx:{}", False), ("torchscript:{}/toge.pt", True)]
)
def test_our_policy_is_the_same_from_image_to_stick(trained_toge, exported_toge, form, dual_rate):
    flags = {"dual_rate": dual_rate, "num_diffusion_steps": STEPS}
    runner, notes = loaded(PolicyRequest(spec=form.format(exported_toge), **flags))
    assert runner.engine.startswith("openvino"), notes
    assert runner.contract.feature_dim == trained_toge.contract.feature_dim
    trained_toge.head.seed_noise(0)
    settings = ExecutionSettings(name="toge", **flags)
    require_same(runner, make_torch_runner(trained_toge, settings))


def write(module: torch.nn.Module, path: Path, shapes: dict[str, tuple[int, ...]]) -> None:
    with warnings.catch_warnings(action="ignore"):
        torch.onnx.export(
            module.eval(),
            tuple(torch.zeros(shape) for shape in shapes.values()),
            path,
            input_names=list(shapes),
            output_names=["out"],
            dynamic_axes={name: {0: "batch"} for name in shapes},
            dynamo=False,
        )


IMAGE, STATE = (1, 3, 32, 32), (1, 13)


def test_one_file_by_the_names_of_a_contract_file(tmp_path: Path) -> None:
    shapes = {"observation.images.front": IMAGE, "observation.state": STATE}
    write(ForwardOnly(), tmp_path / "mine.onnx", shapes)
    (tmp_path / "mavbridge.toml").write_text(
        "[contract]\nimage_height = 32\nimage_width = 32\nhorizon = 8\n"
    )
    request = PolicyRequest(spec=f"onnx:{tmp_path / 'mine.onnx'}", dual_rate=False)
    runner, notes = loaded(request)
    assert "mine.onnx" in notes
    mine = PolicyRequest(spec="helpers.torch_policies:ForwardOnly", dual_rate=False)
    require_same(runner, loaded(mine)[0])


def test_an_encoder_and_a_head(tmp_path: Path) -> None:
    policy = TwoRates()
    write(policy.visual_encoder, tmp_path / "encoder.onnx", {"x": IMAGE})
    shapes = {"feature": (1, DUAL.feature_dim), "state": STATE, "history": (1, 4, 4)}
    write(policy.head, tmp_path / "head.onnx", shapes)
    description = {"contract": json.loads(SINGLE.to_json()), "inputs": {"image": "x"}}
    (tmp_path / "policy.json").write_text(json.dumps(description))
    request = PolicyRequest(spec=f"onnx:{tmp_path}")
    assert read_policy_contract(request).feature_dim == 0
    runner, _ = loaded(request)
    assert runner.contract.feature_dim == DUAL.feature_dim
    require_same(runner, make_torch_runner(policy, ExecutionSettings(name="it")))


@pytest.mark.parametrize("dual_rate", [True, False])
def test_several_cameras_and_observations(tmp_path: Path, dual_rate: bool) -> None:
    policy = Wide()
    write(policy.visual_encoder, tmp_path / "encoder.onnx", {"image": IMAGE})
    shapes = {"sample": (1, 8, 4), "timestep": (1,), "global_cond": (1, 2, 24), "state": (1, 2, 13)}
    write(policy.denoiser, tmp_path / "denoiser.onnx", shapes)
    description = {"contract": json.loads(WIDE.to_json()), "schedule": {"prediction": "sample"}}
    (tmp_path / "policy.json").write_text(json.dumps(description))
    flags: dict[str, Any] = {"dual_rate": dual_rate, "num_diffusion_steps": STEPS}
    runner, _ = loaded(PolicyRequest(spec=f"onnx:{tmp_path}", **flags))
    mine = PolicyRequest(spec="helpers.torch_policies:Wide", engine="torch", **flags)
    require_same(runner, loaded(mine)[0])


def test_bf16_is_flown_only_where_it_agrees(exported_toge, monkeypatch):
    failures = iter(["a stick is off", "a stick is off"])
    monkeypatch.setattr(
        "policy.adapters.onnx.precisions", lambda: (("bf16", "bf16"), ("f32", "f32"))
    )
    monkeypatch.setattr(choose, "parity_failure", lambda *_: next(failures))
    runner, notes = loaded(PolicyRequest(spec=f"onnx:{exported_toge}"))
    assert runner.engine == "openvino-f32"
    assert "openvino-bf16 is passed over: a stick is off" in notes


@pytest.mark.parametrize(
    ("names", "description", "reason"),
    [
        ((), None, "must hold encoder.onnx and denoiser.onnx"),
        (("encoder.onnx",), None, r"it holds \['encoder.onnx'\]"),
        (("encoder.onnx", "head.onnx", "denoiser.onnx"), None, "must hold"),
        (("policy.onnx",), None, "nothing says at which rate"),
        (("policy.onnx",), "{", "is not JSON"),
        (("policy.onnx",), '{"colour": 1}', r"must be an object of \['contract'"),
        (("policy.onnx",), '{"contract": {"horizon": 0}}', "horizon must be an integer"),
        (("policy.onnx",), '{"inputs": {"depth": "d"}}', "inputs .'depth'. are unknown"),
        (("encoder.onnx", "denoiser.onnx"), '{"contract": {}}', "needs the noise schedule"),
    ],
)
def test_a_folder_that_is_no_policy_is_refused_at_once(tmp_path, names, description, reason):
    for name in names:
        (tmp_path / name).write_bytes(b"")
    if description is not None:
        (tmp_path / "policy.json").write_text(description)
    with pytest.raises(PolicyError, match=reason):
        check_request(PolicyRequest(spec=f"onnx:{tmp_path}"))


@pytest.mark.parametrize("flags", [{"engine": "torch"}, {"device": "cuda"}, {"checkpoint": "x"}])
def test_flags_that_do_not_go_with_onnx_are_refused(exported_toge, flags):
    with pytest.raises(PolicyError, match="leave out"):
        check_request(PolicyRequest(spec=f"onnx:{exported_toge}", **flags))  # type: ignore[arg-type]


def test_inputs_that_are_not_known_are_named(tmp_path: Path) -> None:
    write(ForwardOnly(), tmp_path / "policy.onnx", {"image": IMAGE, "thing": STATE})
    (tmp_path / "policy.json").write_text(json.dumps({"contract": json.loads(SINGLE.to_json())}))
    with pytest.raises(PolicyError, match=r"input \['thing'\] is unknown.*'state': \[.*'proprio'"):
        loaded(PolicyRequest(spec=f"onnx:{tmp_path}", dual_rate=False))


def test_new_weights_in_a_file_of_their_own_are_flown(tmp_path: Path) -> None:
    graphs = pytest.importorskip("helpers.foreign_graphs", reason="the extra onnx writes them")

    def throttle() -> float:
        file = GraphFile(path, {"state": Wanted(names=("obs",), shape=(1, 13))}, "chunk")
        return float(file.compile("f32")(state=np.ones((1, 13), np.float32))[0, 0])

    path = tmp_path / "policy.onnx"
    graphs.actor(path, external=True)
    assert throttle() == pytest.approx(0.1)
    weights = path.with_name("policy.onnx.data")
    doubled = 2 * np.frombuffer(weights.read_bytes(), np.float32)
    weights.write_bytes(doubled.tobytes())
    assert throttle() == pytest.approx(0.2)
