"""Policies in ONNX and TorchScript files, ours and those of other tools.

They fly as they are, or are refused in one sentence.
"""

import json
import math
import os
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

pytest.importorskip("onnx", reason="the extra onnx writes the graphs")

import onnx
from onnx import TensorProto

from helpers import foreign_graphs as graphs
from helpers.loaded_policies import act, load, require_same
from helpers.torch_policies import DUAL, SINGLE, WIDE, ForwardOnly, TwoRates, Wide, scripted
from policy.adapters.export import export_onnx
from policy.adapters.onnx import GraphFile, Wanted
from policy.engines import choose
from policy.engines.runner import ExecutionSettings, dummy_sample
from policy.engines.torch_engines import make_torch_runner
from policy.errors import PolicyError, Warned
from policy.loading.load import check_request, read_policy_contract
from policy.loading.request import PolicyRequest
from policy.nets.toge import Toge
from policy.protocol import PolicyRunner

STEPS = 4


@pytest.fixture(scope="module")
def exported_toge(trained_toge: Toge, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("toge")
    export_onnx(trained_toge, folder)
    return folder


@pytest.mark.parametrize("dual_rate", [True, False])
def test_our_policy_is_the_same_from_image_to_stick(trained_toge, exported_toge, dual_rate):
    flags = {"dual_rate": dual_rate, "num_diffusion_steps": STEPS}
    loaded = load(f"onnx:{exported_toge}", **flags)
    runner = loaded.runner
    assert runner.engine.startswith("openvino"), loaded.notes
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
    write(ForwardOnly(), tmp_path / "mine.ONNX", shapes)
    (tmp_path / "mavbridge.toml").write_text(
        "[contract]\nimage_height = 32\nimage_width = 32\nhorizon = 8\n"
    )
    loaded = load(f"onnx:{tmp_path / 'mine.ONNX'}", dual_rate=False)
    assert "mine.ONNX" in "".join(loaded.notes)
    require_same(loaded.runner, load("helpers.torch_policies:ForwardOnly", dual_rate=False).runner)


class Drawing(nn.Module):
    def forward(self, image: Tensor, state: Tensor) -> Tensor:
        return 0.1 * torch.randn(1, 8, 4) + 0 * (image.sum() + state.sum())


def test_a_graph_that_draws_random_numbers_is_warned_of(tmp_path: Path) -> None:
    write(Drawing(), tmp_path / "mine.onnx", {"image": IMAGE, "state": STATE})
    graphs.write_contract(tmp_path, horizon=8)
    loaded = load(f"onnx:{tmp_path / 'mine.onnx'}", dual_rate=False)
    (warning,) = [note for note in loaded.notes if isinstance(note, Warned)]
    assert warning.text.startswith("engine openvino-f32: the same inputs do not give")


@pytest.mark.parametrize("axes", [(), (1, 1)])
def test_an_encoder_and_a_head(tmp_path: Path, axes: tuple[int, ...]) -> None:
    policy = TwoRates()
    write(policy.visual_encoder, tmp_path / "encoder.onnx", {"x": IMAGE})
    shapes = {"feature": (1, DUAL.feature_dim, *axes), "state": STATE, "history": (1, 4, 4)}
    write(policy.head, tmp_path / "head.onnx", shapes)
    description = {"contract": json.loads(SINGLE.to_json()), "inputs": {"image": "x"}}
    (tmp_path / "policy.json").write_text(json.dumps(description))
    spec = f"onnx:{tmp_path}"
    assert read_policy_contract(PolicyRequest(spec=spec)).feature_dim == 0
    runner = load(spec).runner
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
    mine = load("helpers.torch_policies:Wide", engine="torch", **flags)
    require_same(load(f"onnx:{tmp_path}", **flags).runner, mine.runner)


def test_bf16_is_flown_only_where_it_agrees(exported_toge, monkeypatch):
    failures = iter(["an action is off", "an action is off"])
    monkeypatch.setattr(
        "policy.adapters.onnx.precisions", lambda: (("bf16", "bf16"), ("f32", "f32"))
    )
    monkeypatch.setattr(choose, "parity_failure", lambda *_: next(failures))
    loaded = load(f"onnx:{exported_toge}")
    assert loaded.runner.engine == "openvino-f32"
    assert "openvino-bf16 is passed over: an action is off" in "".join(loaded.notes)


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
        (("policy.onnx",), '{"inputs": {"state": ["x"]}}', "inputs must be single names, got"),
        (("policy.onnx",), '{"hidden": {"h": null}}', "hidden must be single names, got"),
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


def test_new_weights_in_a_file_of_their_own_are_flown(tmp_path: Path) -> None:
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


def test_another_output_of_the_same_file_is_flown(tmp_path: Path) -> None:
    path = tmp_path / "policy.onnx"
    outputs = "(float[1,4] less, float[1,4] more) { less = Neg (obs) more = Abs (obs) }"
    graphs.save_graph(path, f"(float[1,4] obs) => {outputs}")
    for output, first in (("less", -1.0), ("more", 1.0)):
        file = GraphFile(path, {"state": Wanted(names=("obs",), shape=(1, 4))}, "chunk", output)
        assert file.compile("f32")(state=np.ones((1, 4), np.float32))[0, 0] == first


Write = Callable[[Path], None]


def fly(spec: str) -> PolicyRunner:
    return load(spec, dual_rate=False).runner


def require_counting(runner: PolicyRunner) -> None:
    """Its hidden state goes from call to call until a reset."""
    for _ in range(2):
        throttles = [act(runner)[0, 0] for _ in range(3)]
        assert throttles == pytest.approx([0.1, 0.2, 0.3], abs=1e-3)
        runner.reset()


@pytest.mark.parametrize("state", ["obs", "x.1"])
def test_one_action_for_one_observation_flies_as_it_is(tmp_path: Path, state: str) -> None:
    graphs.write_contract(tmp_path)
    graphs.actor(tmp_path / "policy.onnx", state=state, outputs=("actions", "values", "log_prob"))
    with pytest.raises(PolicyError, match=r"3 outputs \(actions; values; log_prob\).*outputs"):
        fly(f"onnx:{tmp_path}")
    graphs.describe(tmp_path, outputs={"chunk": "actions"})
    runner = fly(f"onnx:{tmp_path}")
    assert act(runner, vx_mps=2.0)[0] == pytest.approx([0.2] * 4, abs=1e-3)
    assert not runner.has_state, "a server shares it among clients"


def test_state_and_actions_are_in_the_order_and_units_of_the_contract_file(tmp_path: Path) -> None:
    state = '[state]\nnames = ["vx_mps", "yaw_rad"]\nscale = [3.0, 1.0]\n'
    names = '["roll", "pitch", "yaw", "throttle"]'
    action = f"[action]\nnames = {names}\nscale = [1.0, 1.0, 1.0, 0.5]\n"
    graphs.write_contract(tmp_path, more=state + action)
    graphs.actor(tmp_path / "policy.onnx", state_dim=2)
    sticks = act(fly(f"onnx:{tmp_path}"), vx_mps=2.0)[0]
    assert sticks == pytest.approx([0.3, 0.6, 0.6, 0.6], abs=1e-3)


def test_a_timestep_without_axes_is_taken(tmp_path: Path) -> None:
    graphs.write_contract(tmp_path, horizon=8)
    graphs.describe(tmp_path, schedule={"prediction": "sample"})
    graphs.image_actor(tmp_path / "encoder.onnx")
    text = """(float[1,8,4] noisy, int64 timestep) => (float[1,8,4] out) {
        time = Cast <to = 1> (timestep)
        out = Mul (noisy, time)
    }"""
    graphs.save_graph(tmp_path / "denoiser.onnx", text)
    assert act(load(f"onnx:{tmp_path}", num_diffusion_steps=1).runner)[0, 0] in (-1, 1)


@pytest.mark.parametrize("dim", [1, 8, "n"])
def test_a_history_that_is_declared_flat_is_given_flat(tmp_path: Path, dim: int | str) -> None:
    graphs.write_contract(tmp_path)
    text = f"""(float[{dim},16] action_history) => (float[n,m] actions) {{
        ones = Cos (action_history)
        actions = MatMul (ones, w)
    }}"""
    graphs.save_graph(tmp_path / "policy.onnx", text, w=np.full((16, 4), 0.5, np.float32))
    assert act(fly(f"onnx:{tmp_path}")).tolist() == [[8.0] * 4]


def test_a_graph_without_an_axis_for_the_batch_is_given_none(tmp_path: Path) -> None:
    """A softmax over the first axis of four numbers, not over a batch of one."""
    graphs.write_contract(tmp_path)
    text = """(float[3,32,32] image, float[13] obs) => (float[4] actions) {
        colours = ReduceMean <keepdims = 0> (image, sides)
        four = Concat <axis = 0> (colours, zero)
        by_state = MatMul (obs, w)
        scores = Add (four, by_state)
        actions = Softmax <axis = 0> (scores)
    }"""
    weights = {"sides": np.array([1, 2]), "zero": np.zeros(1, "f4"), "w": np.zeros((13, 4), "f4")}
    graphs.save_graph(tmp_path / "policy.onnx", text, **weights)
    runner = fly(f"onnx:{tmp_path}")
    green = np.zeros((graphs.IMAGE_PX, graphs.IMAGE_PX, 3), np.uint8)
    green[..., 1] = 255
    _, state, history = dummy_sample(runner.contract)
    sticks = runner.act(runner.encode(green), state, history)
    assert sticks.shape == (1, 1, 4)
    assert sticks[0, 0] == pytest.approx(np.array([1, math.e, 1, 1]) / (3 + math.e), abs=1e-3)


@pytest.mark.parametrize(
    ("hidden", "shape"),
    [
        *((("h_in", "h_out"), shape) for shape in ((1, 1, 3), ())),
        *((hidden, (1, 1, 3)) for hidden in (("state_in_0", "state_out_0"), ("h", "hn"))),
    ],
)
def test_a_hidden_state_goes_from_call_to_call_until_reset(tmp_path, hidden, shape):
    graphs.write_contract(tmp_path)
    graphs.recurrent(tmp_path / "policy.onnx", hidden=hidden, shape=shape)
    if hidden == ("h", "hn"):
        graphs.describe(tmp_path, hidden={"h": "hn"}, outputs={"chunk": "actions"})
    require_counting(fly(f"onnx:{tmp_path}"))


@pytest.mark.parametrize(
    ("kind", "white"), [(TensorProto.FLOAT16, 1.0), (TensorProto.UINT8, 255.0)]
)
def test_the_element_type_says_what_a_pixel_is(tmp_path: Path, kind: int, white: float) -> None:
    graphs.write_contract(tmp_path)
    graphs.image_actor(tmp_path / "policy.onnx", kind=kind)
    runner = fly(f"onnx:{tmp_path}")
    for level in (0, 1, 255):
        assert act(runner, level=level)[0] == pytest.approx([white * level / 255] * 4, rel=5e-3)


@pytest.mark.parametrize("shape", [(1, 3, 32, 32), ("batch", 3, "height", "width")])
def test_an_observation_of_four_axes_is_an_image(
    tmp_path: Path, shape: tuple[int | str, ...]
) -> None:
    graphs.write_contract(tmp_path)
    graphs.image_actor(tmp_path / "policy.onnx", name="obs", shape=shape)
    assert act(fly(f"onnx:{tmp_path}"), level=255)[0] == pytest.approx([1.0] * 4, rel=5e-3)


def external(path: Path, change: Callable[[Path], object]) -> None:
    graphs.actor(path, external=True)
    change(path.with_name("policy.onnx.data"))


def pointer(path: Path) -> None:
    path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 208\n")


def linked(path: Path) -> None:
    """As in the cache of Hugging Face."""
    blobs = path.parent.with_name(f"{path.parent.name}-blobs")
    blobs.mkdir()
    path.symlink_to(path.rename(blobs / "weights"))


def external_without_length(path: Path) -> None:
    """As ``external``; the entry "length" of the weights, which is optional, is left out."""
    external(path, Path.unlink)
    model = onnx.load(path, load_external_data=False)
    for each in model.graph.initializer:
        kept = [entry for entry in each.external_data if entry.key == "location"]
        del each.external_data[:]
        each.external_data.extend(kept)
    path.write_bytes(model.SerializeToString())


def recurrent_encoder(path: Path) -> None:
    text = """(float[1,3,32,32] image, float[1,3,32,32] h_in)
        => (float[1,3,32,32] feature, float[1,3,32,32] h_out) {
        h_out = Add (image, h_in)
        feature = Neg (h_out)
    }"""
    graphs.save_graph(path.with_name("encoder.onnx"), text)
    path.with_name("head.onnx").touch()


NONZERO = """(float[1,13] obs) => (float[n,m] actions) {
    indices = NonZero (obs)
    actions = Cast <to = 1> (indices)
}"""
GROWING = """(float[1,13] obs, float[1,past,13] kv_in)
    => (float[1,4] actions, float[1,all,13] kv_out) {
    new = Unsqueeze (obs, axis)
    kv_out = Concat <axis = 1> (kv_in, new)
    mean = ReduceMean <keepdims = 0> (kv_out, axis)
    actions = MatMul (mean, w)
}"""
"""Cache of all states so far, as transformers export it."""
VENDORS = "(float[1,13] obs) => (float[1,4] actions) { actions = com.acme.Foo (obs) }"
PRODUCT = "(float[1,13] obs) => (float[1,m] actions) { actions = MatMul (obs, w) }"


def described(path: Path, write: Write = graphs.actor, **tables: Any) -> None:
    write(path)
    graphs.describe(path.parent, **tables)


def cut_short(path: Path) -> None:
    graphs.actor(path)
    os.truncate(path, 150)


def script(path: Path, chunk: str) -> None:
    graphs.save_script(path.with_suffix(".pt"), scripted("image, state", chunk))


REFUSED: dict[str, tuple[Write, str]] = {
    "external data missing": (
        partial(external, change=Path.unlink),
        "data, .* is missing or cut short",
    ),
    "external data a pointer": (
        partial(external, change=pointer),
        "data, .* is a pointer of Git LFS",
    ),
    "external data behind a link": (
        partial(external, change=linked),
        "weights, .* is in another folder: put both files themselves, not links",
    ),
    "external data of no length missing": (external_without_length, "is missing or cut short"),
    "output of no one size": (
        partial(graphs.save_graph, text=NONZERO),
        "which depends on the values",
    ),
    "integer actions": (partial(graphs.actor, action_type=TensorProto.INT64), "is of type i64"),
    "integer image": (
        partial(graphs.image_actor, kind=TensorProto.INT32),
        "image.* is of type i32",
    ),
    "state of another width": (
        partial(graphs.actor, state_dim=17),
        r"its state is \[1,17\], and by the contract \[1, 13\]: set .*\[state\] names",
    ),
    "image of another size": (
        partial(graphs.image_actor, shape=(1, 3, 64, 64)),
        r"its image is \[1,3,64,64\], and by the contract \[1, 3, 32, 32\]: set image_height",
    ),
    "channels last": (partial(graphs.image_actor, shape=(1, 32, 32, 3)), "channels first"),
    "hidden of another shape": (
        partial(described, write=graphs.recurrent, hidden={"h_in": "actions"}),
        r"h_in is \[1, 1, 3\] and its output actions \[1, 4\]",
    ),
    "hidden that grows": (
        partial(graphs.save_graph, text=GROWING, axis=np.array([1]), w=np.eye(13, 4, dtype="f4")),
        r"kv_in is \[1, 1, 13\] and its output kv_out \[1, 2, 13\]: they must be of one shape",
    ),
    "recurrent encoder": (recurrent_encoder, r"encoder cannot have a hidden state, got \['h_in'\]"),
    "no such output": (
        partial(described, outputs={"chunk": "action"}),
        "no output 'action' .actions",
    ),
    "graph cut": (cut_short, r"policy\.onnx cannot be read as ONNX .*copy it again"),
    "operator of a vendor": (
        partial(graphs.save_graph, text=VENDORS),
        r"cannot run \(.*com\.acme\.Foo",
    ),
    "three actions": (
        partial(graphs.save_graph, text=PRODUCT, w=np.zeros((13, 3), np.float32)),
        r"onnx:.*its chunk is \[1, 3\], and its last axis must be the 4 numbers",
    ),
    "not a number": (
        partial(graphs.save_graph, text=PRODUCT, w=np.full((13, 4), np.nan, np.float32)),
        r"onnx:.*NaN or infinity",
    ),
    "unknown input": (
        lambda path: write(ForwardOnly(), path, {"image": IMAGE, "thing": STATE}),
        r"input \['thing'\] is unknown.*'state': \[.*'proprio'",
    ),
    "script of several outputs": (
        # Actions, value and log probability, as Stable Baselines' policies return them.
        lambda path: script(path, "state.sum(), state.sum(1, keepdim=True), state.sum(1)"),
        r"returns 3 values \(0, 1, 2\).*\"chunk\": 0",
    ),
    "script that fails inside of torch": (
        lambda path: script(path, "torch.matmul(state, torch.zeros(7, 4))"),
        r"policy\.pt failed on a state: .*13 and 7x4",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_unusable_graphs_are_refused_in_one_sentence_by_cause(tmp_path: Path, case: str) -> None:
    write, told = REFUSED[case]
    graphs.write_contract(tmp_path)
    write(tmp_path / "policy.onnx")
    script = tmp_path / "policy.pt"
    with pytest.raises(PolicyError, match=told) as refusal:
        fly(f"torchscript:{script}" if script.exists() else f"onnx:{tmp_path}")
    assert "\n" not in str(refusal.value)


def test_torchscript_of_an_observation_alone_flies_and_keeps_its_state(tmp_path: Path) -> None:
    graphs.write_contract(tmp_path)
    path = tmp_path / "policy.pt"
    # As rsl_rl and Isaac Lab export it.
    graphs.save_script(path, scripted("x", "0.1 * x[:, :1].repeat(1, 4)"))
    runner = fly(f"torchscript:{path}")
    assert act(runner, vx_mps=2.0)[0] == pytest.approx([0.2] * 4, abs=1e-3)
    graphs.save_script(path, graphs.CountingActor())
    require_counting(fly(f"torchscript:{path}"))
