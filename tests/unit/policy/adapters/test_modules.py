"""Policies that are torch modules by name: of a user's class, or of a TorchScript archive."""

import io
import json
import pickle
import zipfile
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from helpers.loaded_policies import act, load, require_same
from helpers.torch_policies import DUAL, SINGLE, Encoder, ForwardOnly, NamedDenoiser, scripted
from policy.errors import PolicyError
from policy.loading.load import AS_WRITTEN, check_request, read_policy_contract
from policy.loading.request import PolicyRequest

pytestmark = [
    pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning"),
    pytest.mark.filterwarnings("ignore::torch.jit.TracerWarning"),
]

MINE = "helpers.torch_policies"
CONTRACT = """
[contract]
image_height = 32
image_width = 32
horizon = 8
"""


@pytest.mark.parametrize(
    ("name", "dual_rate"),
    [
        ("ForwardOnly", False),
        ("NamedHead", True),
        ("NamedDenoiser", False),
        ("Wide", True),
        ("Wide", False),
    ],
)
def test_a_class_of_torch_modules_flies_converted(name: str, dual_rate: bool) -> None:
    loaded = load(f"{MINE}:{name}", dual_rate=dual_rate, num_diffusion_steps=4)
    assert loaded.runner.engine.startswith("openvino"), loaded.notes
    assert loaded.runner.contract.feature_dim == (0 if name == "ForwardOnly" else DUAL.feature_dim)


@pytest.mark.parametrize(
    ("name", "dual_rate"),
    [
        ("TwoRates", True),
        ("PlainClass", False),
        ("Scripted", True),
        ("Listed", True),
        ("ModuleAsMethod", False),
        ("Stepwise", True),
        ("Stepwise", False),
    ],
)
def test_a_class_with_methods_of_its_own_is_converted_on_request(
    name: str, dual_rate: bool
) -> None:
    flags: Any = {"dual_rate": dual_rate, "num_diffusion_steps": 4}
    written = load(f"{MINE}:{name}", **flags)
    assert written.runner.engine == "torch"
    assert written.notes[-1] == AS_WRITTEN
    loaded = load(f"{MINE}:{name}", **flags, engine="openvino")
    assert loaded.runner.engine.startswith("openvino"), loaded.notes


def test_modules_that_make_no_policy_are_refused() -> None:
    with pytest.raises(PolicyError, match="it takes forward alone, visual_encoder and action_head"):
        load(f"{MINE}:Incomplete")


FORWARD_EXAMPLES = (torch.zeros(1, 3, 32, 32), torch.zeros(1, SINGLE.state_dim))


def archive(tmp_path: Path, module: nn.Module, description: object = None) -> Path:
    path = tmp_path / "mine.pt"
    extra = {} if description is None else {"policy.json": json.dumps(description)}
    torch.jit.script(module.eval()).save(path, _extra_files=extra)
    return path


class Container(nn.Module):
    """A module without forward that holds those of another policy."""

    def __init__(self, holder: object) -> None:
        super().__init__()
        for name, module in vars(holder).items():
            examples: tuple[torch.Tensor, ...] = (torch.zeros(1, 3, 32, 32),)
            if name != "visual_encoder":
                feature, state = torch.zeros(1, DUAL.feature_dim), torch.zeros(1, 13)
                examples = (feature, state, torch.zeros(1, 4, 4))
                if name == "denoiser":
                    examples = (torch.zeros(1, DUAL.horizon, 4), torch.zeros(1), *examples)
            trace = torch.jit.trace
            self.add_module(name, trace(module.eval(), examples, check_trace=False))


def described(**more: object) -> dict[str, object]:
    return {"contract": json.loads(SINGLE.to_json()), **more}


def test_an_archive_with_named_modules_says_all_of_itself(tmp_path: Path) -> None:
    schedule = {"prediction": "epsilon", "betas": "linear"}
    path = archive(tmp_path, Container(NamedDenoiser()), described(schedule=schedule))
    spec = f"torchscript:{path}"
    assert read_policy_contract(PolicyRequest(spec=spec)).horizon == SINGLE.horizon
    archived, mine = (load(each, num_diffusion_steps=4) for each in (spec, f"{MINE}:NamedDenoiser"))
    assert archived.runner.engine.startswith("openvino"), archived.notes
    require_same(archived.runner, mine.runner)


def test_an_archive_with_forward_flies_by_a_contract_file(tmp_path: Path) -> None:
    path = archive(tmp_path, torch.jit.trace(ForwardOnly().eval(), FORWARD_EXAMPLES))
    (tmp_path / "mine.toml").write_text(CONTRACT)
    spec = f"torchscript:{path}"
    archived = load(spec, contract_file=tmp_path / "mine.toml", dual_rate=False)
    assert archived.runner.engine.startswith("openvino"), archived.notes
    require_same(archived.runner, load(f"{MINE}:ForwardOnly", dual_rate=False).runner)
    with pytest.raises(PolicyError, match=r"give --contract FILE\.toml"):
        check_request(PolicyRequest(spec=spec))


def weights() -> bytes:
    buffer = io.BytesIO()
    torch.save(Encoder().state_dict(), buffer)
    return buffer.getvalue()


def test_the_decisions_of_a_script_are_kept(tmp_path: Path) -> None:
    decides = "torch.zeros(1, 8, 4) + (0.5 if bool(state[0, 0] > 0) else 0.0)"
    path = archive(tmp_path, scripted("image, state", decides), described())
    runner = load(f"torchscript:{path}", dual_rate=False).runner
    assert [act(runner, vx_mps=vx)[0, 0] for vx in (1.0, -1.0)] == [0.5, 0.0]


def test_optional_settings_keep_their_defaults(tmp_path: Path) -> None:
    plain, settable = (
        load(f"{MINE}:{name}", dual_rate=False).runner for name in ("ForwardOnly", "Settable")
    )
    require_same(plain, settable)
    settable = scripted("state, scale: float = 1.0", "torch.zeros(1, 8, 4) + scale * state.sum()")
    path = archive(tmp_path, settable, described())
    runner = load(f"torchscript:{path}", dual_rate=False).runner
    assert act(runner, vx_mps=0.5)[0, 0] == pytest.approx(act(runner)[0, 0] + 0.5, abs=1e-3)


def test_wrapped_modules_get_the_arguments_that_they_declare() -> None:
    plain, wrapped = (
        load(f"{MINE}:{name}", engine="torch").runner
        for name in ("NamedSettableHead", "WrappedHead")
    )
    require_same(plain, wrapped)


def test_one_input_that_may_be_a_state_or_an_image_is_not_guessed(tmp_path: Path) -> None:
    flattening = scripted("x", "torch.zeros(1, 8, 4) + x.flatten()[0]")
    path = archive(tmp_path, flattening, described())
    with pytest.raises(PolicyError, match=r"its x may be a state or an image.*policy\.json"):
        load(f"torchscript:{path}", dual_rate=False)
    path = archive(tmp_path, flattening, described(inputs={"state": "x"}))
    runner = load(f"torchscript:{path}", dual_rate=False).runner
    assert act(runner, vx_mps=0.5)[0, 0] == pytest.approx(0.5, abs=1e-3)


@pytest.mark.parametrize("inputs", [{"image": "obs"}, {}])
def test_an_observation_that_only_an_image_fits_is_one(tmp_path: Path, inputs: object) -> None:
    mean = scripted("obs", "(torch.zeros(1, 8, 4) + obs.mean(dim=(1, 2, 3))).to(torch.bfloat16)")
    path = archive(tmp_path, mean, described(inputs=inputs))
    runner = load(f"torchscript:{path}", engine="torch", dual_rate=False).runner
    assert act(runner, level=255)[0, 0] > act(runner, level=0)[0, 0]


def test_an_input_that_fits_nothing_is_refused_with_both_reasons(tmp_path: Path) -> None:
    path = archive(tmp_path, torch.jit.script(nn.Linear(13, 4).half()), described())
    said = r"input takes neither a state \[1, 13\] \(.*same dtype.*nor an image \[1, 3, 32, 32\] \("
    with pytest.raises(PolicyError, match=said):
        load(f"torchscript:{path}", dual_rate=False)


@pytest.mark.parametrize(
    ("signature", "shape", "told"),
    [
        ("state, image", (1, 8, 4), "image, state, action_history, passed in this order"),
        ("image, history", (1, 8, 4), "image, state, action_history, passed in this order"),
        ("image, state", (2, 1, 8, 4), r"must be \[1, 8, 4\] by its contract, got \[2, 1, 8, 4\]"),
    ],
)
def test_other_arguments_and_chunks_are_refused(tmp_path, signature, shape, told):
    path = archive(tmp_path, scripted(signature, f"torch.zeros({shape})"), described())
    with pytest.raises(PolicyError, match=told):
        load(f"torchscript:{path}", dual_rate=False)


class Normed(nn.Module):
    def __init__(self, *, has_averages: bool = True) -> None:
        super().__init__()
        self.norm = nn.BatchNorm2d(3, track_running_stats=has_averages)

    def forward(self, image: torch.Tensor, state: torch.Tensor) -> torch.Tensor:
        return torch.zeros(1, 8, 4) + self.norm(image).square().mean()


def test_a_batch_norm_that_was_traced_in_training_mode_is_refused(tmp_path: Path) -> None:
    for module in (Normed().eval(), Normed(has_averages=False).train()):
        path = archive(tmp_path, torch.jit.trace(module, FORWARD_EXAMPLES[:2]), described())
        assert load(f"torchscript:{path}", dual_rate=False)
    path = archive(tmp_path, torch.jit.trace(Normed().train(), FORWARD_EXAMPLES[:2]), described())
    with pytest.raises(PolicyError, match=r"traced in training mode.*call eval\(\)"):
        load(f"torchscript:{path}", dual_rate=False)


def zipped(description: bytes) -> bytes:
    with zipfile.ZipFile(content := io.BytesIO(), "w") as file:
        file.writestr("mine/code/x.py", "")
        file.writestr("mine/extra/policy.json", description)
    return content.getvalue()


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (None, "there is no file"),
        (b"junk", "cannot be read"),
        (b"", "is empty, or cut short"),
        (weights(), "is not a TorchScript archive"),
        (pickle.dumps({"weights": 1}), "is not a TorchScript archive"),
        (zipped(b"\xef\xbb\xbf{}"), "nothing says at which rate"),
        (zipped("{}".encode("utf-16")), "policy.json cannot be read: it is text in UTF-16"),
    ],
)
def test_a_file_that_is_no_archive_is_refused(
    tmp_path: Path, content: bytes | None, reason: str
) -> None:
    path = tmp_path / "mine.pt"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(PolicyError, match=reason):
        check_request(PolicyRequest(spec=f"torchscript:{path}"))
