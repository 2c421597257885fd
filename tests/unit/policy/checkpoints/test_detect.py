"""Foreign files and folders, made up small: each is named, and its way to fly."""

import io
import json
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from policy.checkpoints.header import detect, read_contract
from policy.errors import CheckpointError, PolicyError
from policy.loading.load import check_request
from policy.loading.request import PolicyRequest

ACT = json.dumps({"type": "act", "input_features": {}, "output_features": {}})
PI0 = json.dumps({"type": "pi0", "input_features": {}, "output_features": {}})
SAFETENSORS, TORCH = "model.safetensors", "model.pt"


def tensors(*names: str) -> dict[str, torch.Tensor]:
    return {name: torch.zeros(2, 2) for name in names}


def saved(content: object, **options: bool) -> bytes:
    buffer = io.BytesIO()
    torch.save(content, buffer, **options)
    return buffer.getvalue()


def zipped(*names: str) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name in names:
            archive.writestr(name, "text")
    return buffer.getvalue()


def header_of(entries: dict[str, str]) -> bytes:
    """A safetensors file of scalars with any dtypes; no reader looks at its data here."""
    text = json.dumps({name: {"dtype": kind} for name, kind in entries.items()}).encode()
    return struct.pack("<Q", len(text)) + text


LFS = b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 1\n"
FILES: list[tuple[str, Callable[[], bytes], str]] = [
    (TORCH, lambda: b"", "is empty, or cut short: copy it again"),
    (SAFETENSORS, lambda: LFS, "is a pointer of Git LFS.*git lfs pull"),
    ("m.onnx", lambda: b"\x08\x08\x12\x07pytorch", r"--policy onnx:.*m\.onnx"),
    (TORCH, lambda: zipped("m/data.pkl", "m/code/m.py"), "TorchScript archive.*torchscript:"),
    ("m.zip", lambda: zipped("a/weights.bin"), "a zip archive: unpack"),
    ("m.pt2", lambda: zipped("m/archive_format"), r"a program of torch\.export: .*--policy onnx:"),
    (
        "m.zip",
        lambda: zipped("policy.pth", "_stable_baselines3_version"),
        r"a model of Stable-Baselines3: .*--policy onnx:",
    ),
    (TORCH, lambda: saved(tensors("a"))[:300], "cut short, or damaged"),
    (
        SAFETENSORS,
        lambda: header_of({"diffusion.unet.down.weight": "F32"}),
        "LeRobot policy, without the config.json.*lerobot:DIR",
    ),
]


@pytest.mark.parametrize(("name", "make", "message"), FILES)
def test_a_foreign_file_is_named_with_its_way_to_fly(tmp_path, name, make, message):
    path = tmp_path / name
    path.write_bytes(make())
    for refuse in (
        lambda: read_contract(path),
        lambda: check_request(PolicyRequest(spec="toge", checkpoint=path)),
        lambda: check_request(PolicyRequest(spec=str(path))),
    ):
        with pytest.raises(PolicyError, match=message) as caught:
            refuse()
        assert str(path) in str(caught.value)


FOLDERS: list[tuple[dict[str, str], str]] = [
    ({"config.json": ACT}, r"LeRobot policy \(act\).*--policy lerobot:{}$"),
    ({"config.json": PI0}, "of type 'pi0'.*act and diffusion fly.*ws://"),
    ({"pretrained_model/config.json": ACT}, "--policy lerobot:{}/pretrained_model"),
    (
        {"checkpoints/last/pretrained_model/config.json": ACT},
        "--policy lerobot:{}/checkpoints/last/pretrained_model",
    ),
    ({"meta/info.json": "{}"}, "data set, not a policy: train one: mavbridge train {}"),
    ({"ticks.parquet": ""}, "recorded flight, not a policy"),
    ({"encoder.onnx": "", "step.onnx": ""}, "--policy onnx:{}"),
    ({"notes.txt": "", "config.json": "[]"}, r"a folder.*'notes\.txt'"),
    ({"config.json": "[" * 100_000}, "a folder"),
]


@pytest.mark.parametrize(("files", "message"), FOLDERS)
def test_a_foreign_folder_is_named_with_its_way_to_fly(tmp_path, files, message):
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    for request in (
        PolicyRequest(spec="toge", checkpoint=tmp_path),
        PolicyRequest(spec=str(tmp_path)),
    ):
        with pytest.raises(PolicyError, match=message.replace("{}", str(tmp_path))):
            check_request(request)


def test_weights_of_a_lerobot_folder_name_the_folder(tmp_path: Path) -> None:
    save_file(tensors("model.encoder.weight"), tmp_path / SAFETENSORS)
    (tmp_path / "config.json").write_text(ACT)
    with pytest.raises(CheckpointError, match=f"the weights of a LeRobot.*lerobot:{tmp_path}$"):
        read_contract(tmp_path / SAFETENSORS)


@pytest.mark.parametrize("content", [b"PK", b"\x80\x02cos", b"\xff" * 64, b"12345678{", b"{"])
def test_unknown_content_is_left_to_its_reader(tmp_path: Path, content: bytes) -> None:
    (tmp_path / TORCH).write_bytes(content)
    assert detect(tmp_path / TORCH) is None


@pytest.mark.parametrize("kind", ["lerobot", "onnx", "torchscript"])
def test_a_form_of_a_foreign_policy_names_the_kind_of_its_file(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "policy.onnx"
    path.write_bytes(b"<html>")
    with pytest.raises(PolicyError, match=rf"^--policy {kind}:{path}: .*is a web page"):
        check_request(PolicyRequest(spec=f"{kind}:{path}"))


@pytest.mark.parametrize("spec", ["toge", "scripted:hover", "./mine.py:Mine"])
def test_a_contract_file_that_has_no_use_is_refused(tmp_path: Path, spec: str) -> None:
    with pytest.raises(PolicyError, match=r"has a contract of its own.*leave it out"):
        check_request(PolicyRequest(spec=spec, contract_file=tmp_path / "contract.toml"))


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("lerobot/diffusion_pusht", "hf download lerobot/diffusion_pusht --local-dir DIR"),
        ("./absent.onnx", "no such file or folder"),
    ],
)
def test_a_name_of_the_hub_is_not_taken_for_a_path(spec: str, message: str) -> None:
    with pytest.raises(PolicyError, match=message):
        check_request(PolicyRequest(spec=spec))


def test_weights_of_ours_given_as_the_policy_say_which_flag(tmp_path: Path) -> None:
    path = tmp_path / TORCH
    path.write_bytes(saved(tensors("a")))
    with pytest.raises(PolicyError, match=f"--checkpoint {path}"):
        check_request(PolicyRequest(spec=str(path)))
