import json
import math
import os
import pickle
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from policy.checkpoints.header import read_contract
from policy.checkpoints.networks import load_checkpoint, save_checkpoint
from policy.checkpoints.tensors import pack, read_tensors, unpack
from policy.contract import Contract
from policy.errors import CheckpointError
from policy.nets.diffusion import NoiseSchedule
from policy.nets.toge import Toge, TogeConfig


@pytest.fixture(scope="module")
def saved(small_toge: Toge, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A good checkpoint; not to be changed by a test."""
    path = tmp_path_factory.mktemp("checkpoint") / "toge.safetensors"
    save_checkpoint(path, small_toge)
    return path


def test_the_file_alone_says_what_it_is(tmp_path: Path) -> None:
    contract = Contract(image_height=32, image_width=48, state_frame="enu_flu", horizon=8)
    schedule = NoiseSchedule(betas="linear", num_train_timesteps=50)
    config = TogeConfig(backbone="resnet8", contract=contract, schedule=schedule)
    policy = Toge(config).eval()
    path = tmp_path / "a.safetensors"
    save_checkpoint(path, policy)
    assert read_tensors(path)[1]["test_vector.chunks"].abs().max() > 0.1
    loaded = load_checkpoint(path, fallback=TogeConfig())
    assert loaded.config == policy.config
    assert not loaded.training
    for name, value in policy.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], value), name
    assert [p.name for p in tmp_path.iterdir()] == ["a.safetensors"]


def test_each_packed_weight_is_off_by_at_most_half_a_step() -> None:
    random = torch.Generator().manual_seed(0)
    plain = {
        "backbone.conv.weight": torch.randn(8, 3, 3, 3, generator=random),
        "backbone.dead.weight": torch.zeros(4, 2, 1, 1),
        "backbone.norm.weight": torch.tensor([1e-9, 1e9]),
        "backbone.norm.num_batches_tracked": torch.tensor(7),
        "head.weight": torch.randn(5, 4, generator=random),
    }
    state = unpack(pack(plain, coarse="backbone."))
    conv = plain.pop("backbone.conv.weight")
    step = conv.flatten(1).abs().amax(dim=1) / 127
    off = (state.pop("backbone.conv.weight") - conv).flatten(1).abs().amax(dim=1)
    assert bool((off <= 0.5001 * step).all() and (off > 0).any())
    torch.testing.assert_close(state, plain, rtol=2**-11, atol=0, check_dtype=False)


Change = str | dict[str, Any] | None
"""Of a header's entry: its new text, new values in its JSON, or its removal."""


@pytest.mark.parametrize(
    ("key", "change", "message"),
    [
        ("contract", {"version": 9}, "version 9 is not supported"),
        ("contract", {"feature_dim": 384}, "feature_dim 384"),
        ("contract", "[" * 100_000, r"a\.safetensors"),
        ("contract", "null", r"a\.safetensors"),
        ("contract", None, "save_checkpoint"),
        (
            "architecture",
            {"size": "huge"},
            "size must be 'small' or 'medium' or 'large', got 'huge'",
        ),
        ("architecture", {"backbone": "vgg16"}, "backbone must be 'resnet8' or .*, got 'vgg16'"),
        ("architecture", {"policy": "other"}, "holds a other, which is no network of ours"),
        ("architecture", {"depth": 3}, "malformed architecture"),
        (
            "architecture",
            {"schedule": {"betas": "quadratic"}},
            "betas must be 'squared_cosine' or 'linear', got 'quadratic'",
        ),
        ("architecture", "[" * 100_000, r"a\.safetensors"),
        ("architecture", "null", "malformed architecture"),
        ("architecture", "{", "malformed architecture"),
        ("architecture", None, "save_checkpoint"),
    ],
)
def test_headers_of_another_build_are_refused(
    saved: Path, tmp_path: Path, key: str, change: Change, message: str
) -> None:
    header, path = read_tensors(saved)[0], tmp_path / "a.safetensors"
    text = header.pop(key)
    if change is not None:
        merged = json.dumps({**json.loads(text), **change}) if isinstance(change, dict) else change
        header[key] = merged
    # Next to no weights: the header is looked at first.
    save_file({"weight": torch.zeros(1)}, path, metadata=header)
    reads = [partial(load_checkpoint, fallback=TogeConfig())]
    if key == "contract" and "feature_dim" not in message:  # that is the network's to say
        reads.append(read_contract)
    for read in reads:
        with pytest.raises(CheckpointError, match=message) as caught:
            read(path)
        assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("test_vector.chunks", lambda x: x + 0.02, r"off by 0\.02.*damaged"),
        ("test_vector.rgb", lambda x: x.float(), "test vector is damaged: its rgb must be .*uint8"),
        ("test_vector.state", lambda x: x.bfloat16(), "damaged: its state must be .*float32"),
        ("test_vector.state", lambda x: x[:, :12], "test vector is damaged: .*copy the file"),
        ("test_vector.history", None, "test vector is damaged: it must hold"),
        ("head.unet.out.weight", lambda x: -x, "do not make the sticks that they made"),
        ("fusion.mlp.0.weight", lambda x: x * math.nan, r"NaN.*fusion\.mlp\.0\.weight"),
    ],
)
def test_weights_that_are_not_those_that_were_saved_are_refused(
    small_toge, saved, tmp_path, name, change, message
):
    header, contents = read_tensors(saved)
    before = contents.pop(name)
    if change is not None:
        contents[name] = change(before).contiguous()
    path = tmp_path / "a.safetensors"
    save_file(contents, path, metadata=header)
    with pytest.raises(CheckpointError, match=message):
        load_checkpoint(path, fallback=small_toge.config)


def test_weights_that_are_not_finite_are_not_saved(small_toge: Toge, tmp_path: Path) -> None:
    policy = Toge(small_toge.config)
    with torch.no_grad():
        policy.head.unet.out.weight[0, 0] = float("inf")
    with pytest.raises(CheckpointError, match=r"head\.unet\.out\.weight"):
        save_checkpoint(tmp_path / "a.safetensors", policy)


class Malicious:
    """Runs a program when unpickled."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.marker),)


@pytest.mark.parametrize("protocol", [None, 0, 4])
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


def test_a_missing_file_names_what_is_there(small_toge: Toge, saved: Path) -> None:
    with pytest.raises(CheckpointError, match=r"no such file.*toge\.safetensors"):
        load_checkpoint(saved.with_name("other.pt"), fallback=small_toge.config)
    with pytest.raises(CheckpointError, match=r"\.safetensors, \.pt, \.pth"):
        load_checkpoint(saved.with_suffix(".onnx"), fallback=small_toge.config)


# --- Files of torch.save

NAME = "fusion.mlp.0.weight"
State = dict[str, Tensor]


def behind(prefix: str, state: State) -> State:
    return {prefix + name: value for name, value in state.items()}


@pytest.mark.parametrize(
    "wrap",
    [
        lambda s: s,
        lambda s: behind("module.", s),
        lambda s: {"epoch": 3, "state_dict": behind("_orig_mod.", s), "optimizer": {"state": {}}},
        lambda s: behind("_orig_mod.module.", s),
        lambda s: {"model_state_dict": s, "rng_state": {"torch": torch.get_rng_state()}},
        lambda s: {"state_dict": s, "metrics": {"loss": torch.ones(())}, "std": {"s": s[NAME][0]}},
    ],
)
def test_state_dicts_load_bare_and_as_training_loops_save_them(small_toge, tmp_path, wrap):
    state, path = small_toge.state_dict(), tmp_path / "a.ckpt"
    torch.save(wrap(dict(state)), path)
    loaded = load_checkpoint(path, fallback=small_toge.config).state_dict()
    assert all(torch.equal(loaded[name], value) for name, value in state.items())


@pytest.mark.parametrize(
    ("wrap", "message"),
    [
        (lambda s: nn.Linear(2, 2), r"holds a torch\.nn.*--policy torchscript:FILE"),
        (lambda s: {"state_dict": s, "contract": "{}"}, "holds a contract"),
        (lambda s: torch.optim.Adam([nn.Parameter(s[NAME])]).state_dict(), "no weights found"),
        (lambda s: {"shadow_params": list(s.values())}, "no weights found"),
        (lambda s: {"model": s}, r"it holds \['model'\].*save model.state_dict"),
        (
            lambda s: {"state_dict": s, "ema": {n: s[n] for n in s if n.startswith("head")}},
            "weights as 'state_dict' and 'ema': .* alone",
        ),
        (
            lambda s: {name: value for name, value in s.items() if name != NAME},
            r"missing 'fusion\.mlp\.0\.weight'",
        ),
        (lambda s: {**s, "n_averaged": torch.tensor(3)}, "1 places: unexpected 'n_averaged'.* own"),
        (
            lambda s: {"state_dict": behind("model.", s), "callbacks": {}},
            r"missing 'backbone\.conv1.*; unexpected 'model\.backbone.* begin with 'model\.': save",
        ),
        (lambda s: {**s, "vast": torch.zeros(1).expand(1 << 40)}, "unexpected 'vast'"),
        (lambda s: {**s, NAME: s[NAME].to_sparse()}, f"'{NAME}' is no dense tensor of real"),
        (lambda s: {**s, NAME: s[NAME].to("meta")}, f"'{NAME}' is no dense tensor of real"),
        (lambda s: {**s, NAME: s[NAME].double() * 1e300}, f"NaN or infinity.*'{NAME}'"),
        *(
            (lambda s, dtype=dtype: {**s, NAME: s[NAME].to(dtype)}, f"real numbers, but {dtype}")
            for dtype in (torch.int8, torch.bool, torch.complex64, torch.float8_e4m3fn)
        ),
        (lambda s: {**s, NAME: torch.zeros(3, 7)}, r"is \[3, 7\], must be \[512"),
        (
            lambda s: Toge(TogeConfig(backbone="resnet18")).state_dict(),
            r"does not fit this policy in \d+ places: missing.*size and encoder",
        ),
    ],
)
def test_torch_files_without_weights_of_this_network_are_refused(
    small_toge, tmp_path, wrap, message
):
    path = tmp_path / "a.pt"
    torch.save(wrap(dict(small_toge.state_dict())), path)
    with pytest.raises(CheckpointError, match=message):
        load_checkpoint(path, fallback=small_toge.config)
