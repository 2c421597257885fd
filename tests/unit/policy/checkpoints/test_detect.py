"""Foreign files and folders, made up small: each is named, and its way to fly."""

import io
import json
import os
import pickle
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from policy.checkpoints.detect import detect
from policy.checkpoints.header import read_contract
from policy.errors import CheckpointError, PolicyError
from policy.loading.load import check_request
from policy.loading.request import PolicyRequest

ACT = json.dumps({"type": "act", "input_features": {}, "output_features": {}})
PI0 = json.dumps({"type": "pi0", "input_features": {}, "output_features": {}})
SAFETENSORS, TORCH = "model.safetensors", "model.pt"


@pytest.mark.parametrize("name", ["weights.safetensors", "weights.pt"])
def test_a_pipe_is_refused_and_not_waited_for(tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / name)
    with pytest.raises(CheckpointError, match="not a file but a pipe or a device"):
        read_contract(tmp_path / name)


class Runs:
    """Makes a folder if it is unpickled."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.marker),)


def tensors(*names: str, dtype: torch.dtype = torch.float32) -> dict[str, torch.Tensor]:
    return {name: torch.zeros(2, 2, dtype=dtype) for name in names}


def saved(content: object, **options: bool) -> bytes:
    buffer = io.BytesIO()
    torch.save(content, buffer, **options)
    return buffer.getvalue()


def exported() -> bytes:
    buffer = io.BytesIO()
    torch.export.save(torch.export.export(nn.Linear(2, 2), (torch.zeros(1, 2),)), buffer)
    return buffer.getvalue()


def arrays() -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, weight=np.zeros(3))
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


FILES: list[tuple[str, str, Callable[[], bytes], str]] = [
    ("empty", TORCH, lambda: b"", "is empty, or cut short: copy it again"),
    (
        "lfs",
        SAFETENSORS,
        lambda: b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 1\n",
        "is a pointer of Git LFS.*git lfs pull",
    ),
    ("html", SAFETENSORS, lambda: b"\n<!DOCTYPE html><html>", "is a web page.*download it again"),
    ("openvino", "m.xml", lambda: b'<?xml version="1.0"?>\n<net name="m">', "OpenVINO model"),
    ("onnx", "m.onnx", lambda: b"\x08\x08\x12\x07pytorch", r"--policy onnx:.*m\.onnx"),
    ("hdf5", "m.h5", lambda: b"\x89HDF\r\n\x1a\n", r"HDF5.*\./file\.py:Class"),
    ("gguf", "m.gguf", lambda: b"GGUF\x03", "llama"),
    ("tflite", "m.tflite", lambda: b"\x1c\0\0\0TFL3", "TensorFlow Lite"),
    ("gzip", "m.tar.gz", lambda: b"\x1f\x8b\x08\0", "unpack it"),
    ("tar", "m.tar", lambda: b"m" + b"\0" * 256 + b"ustar\0", "unpack it"),
    (
        "torchscript",
        TORCH,
        lambda: zipped("m/data.pkl", "m/code/m.py", "m/constants.pkl"),
        r"a TorchScript archive.*--policy torchscript:.*model\.pt",
    ),
    ("torch.export", "m.pt2", exported, "torch.export.*onnx:FILE"),
    ("numpy", "m.npz", arrays, "numpy arrays"),
    ("zip", "m.zip", lambda: zipped("a/weights.bin"), "a zip archive: unpack"),
    ("cut zip", TORCH, lambda: saved(tensors("a"))[:300], "cut short, or damaged"),
    ("module", TORCH, lambda: saved(nn.Linear(2, 2)), r"pickled object \(torch.nn.*state_dict\(\)"),
    ("module", TORCH, lambda: saved({"model": nn.Linear(2, 2)}), "whole pickled modules"),
    (
        "old module",
        TORCH,
        lambda: pickle.dumps(nn.Linear(2, 2)),
        "pickled object.*torchscript:FILE",
    ),
    (
        "legacy module",
        TORCH,
        lambda: saved(nn.Linear(2, 2), _use_new_zipfile_serialization=False),
        r"pickled object \(torch.nn",
    ),
    (
        "config beside weights",
        TORCH,
        lambda: saved({"state_dict": tensors("a"), "hyper_parameters": {"path": Path("x")}}),
        r"other pickled objects beside them \(pathlib.*weights_only=False",
    ),
    (
        "quantised tensors",
        TORCH,
        lambda: b"\x80\x02}ctorch._utils\n_rebuild_qtensor\n.",
        "a quantised network: save the state_dict of the one with floating-point",
    ),
    ("fp8", SAFETENSORS, lambda: header_of({"a": "F8_E4M3", "b": "BF16"}), "quantised network"),
    ("gptq", SAFETENSORS, lambda: header_of({"a.qweight": "I32", "b": "F16"}), "quantised network"),
    ("lora", SAFETENSORS, lambda: header_of({"a.lora_A.weight": "F16"}), "LoRA adapter.*merge"),
    ("optimiser", SAFETENSORS, lambda: header_of({"state.0.exp_avg": "F32"}), "an optimiser"),
    (
        "diffusion",
        SAFETENSORS,
        lambda: header_of({"diffusion.unet.down.weight": "F32"}),
        "LeRobot policy, without the config.json.*lerobot:DIR",
    ),
]


@pytest.mark.parametrize(
    ("name", "make", "message"),
    [each[1:] for each in FILES],
    ids=[each[0] for each in FILES],
)
def test_a_foreign_file_is_named_with_its_way_to_fly(
    tmp_path: Path, name: str, make: Callable[[], bytes], message: str
) -> None:
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


FOLDERS: list[tuple[str, dict[str, str], str]] = [
    ("act", {"config.json": ACT}, r"LeRobot policy \(act\).*--policy lerobot:{}$"),
    ("pi0", {"config.json": PI0}, "of type 'pi0'.*act and diffusion fly.*ws://"),
    ("training", {"pretrained_model/config.json": ACT}, "--policy lerobot:{}/pretrained_model"),
    (
        "run",
        {"checkpoints/last/pretrained_model/config.json": ACT},
        "--policy lerobot:{}/checkpoints/last/pretrained_model",
    ),
    ("diffusers", {"model_index.json": "{}"}, "pipeline of diffusers"),
    ("unet", {"config.json": '{"_class_name": "UNet1DModel"}'}, r"diffusers \(UNet1DModel\)"),
    ("transformers", {"config.json": '{"model_type": "vit"}'}, r"Hugging Face model \(vit\)"),
    ("data", {"meta/info.json": "{}"}, "data set, not a policy: train one: mavbridge train {}"),
    ("flight", {"ticks.parquet": ""}, "recorded flight, not a policy"),
    ("lora", {"adapter_config.json": "{}"}, "LoRA adapter"),
    ("onnx", {"encoder.onnx": "", "step.onnx": ""}, "--policy onnx:{}"),
    ("tensorflow", {"saved_model.pb": ""}, "TensorFlow model"),
    ("jax", {"_METADATA": ""}, "JAX checkpoint.*ws://"),
    ("package", {"__init__.py": ""}, "a Python package: name a class in it"),
    ("other", {"notes.txt": "", "config.json": "[]"}, r"a folder.*'notes\.txt'"),
    ("deep", {"config.json": "[" * 100_000}, "a folder"),
]


@pytest.mark.parametrize(
    ("files", "message"), [each[1:] for each in FOLDERS], ids=[each[0] for each in FOLDERS]
)
def test_a_foreign_folder_is_named_with_its_way_to_fly(
    tmp_path: Path, files: dict[str, str], message: str
) -> None:
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


@pytest.mark.parametrize("protocol", [None, 2, 4])
def test_no_pickle_is_run_to_be_named(tmp_path: Path, protocol: int | None) -> None:
    marker, path = tmp_path / "ran", tmp_path / TORCH
    content = {"state_dict": Runs(marker)}
    path.write_bytes(saved(content) if protocol is None else pickle.dumps(content, protocol))
    assert "could run any program" in str(detect(path))
    assert not marker.exists()


@pytest.mark.parametrize(
    "content",
    [tensors("a"), {"state_dict": tensors("a"), "epoch": 3}, nn.Linear(2, 2).state_dict()],
)
def test_plain_weights_are_left_to_their_reader(tmp_path: Path, content: object) -> None:
    (tmp_path / TORCH).write_bytes(saved(content))
    assert detect(tmp_path / TORCH) is None


@pytest.mark.parametrize(
    "content", [b"\x80", b"PK", b"\x80\x02cos", b"\xff" * 64, b"12345678{", b"{"]
)
def test_what_is_unknown_is_left_to_its_reader(tmp_path: Path, content: bytes) -> None:
    (tmp_path / TORCH).write_bytes(content)
    assert detect(tmp_path / TORCH) is None


@pytest.mark.parametrize("kind", ["lerobot", "onnx", "torchscript"])
@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"<html>", "is a web page"),
        (b"\x80\x02ctorch.nn.modules.linear\nLinear\n.", "is a whole pickled object"),
        (b"version https://git-lfs.github.com/spec/v1\n", "git lfs pull"),
    ],
)
def test_a_form_of_a_foreign_policy_names_what_else_its_file_is(
    tmp_path: Path, kind: str, content: bytes, message: str
) -> None:
    path = tmp_path / "policy.onnx"
    path.write_bytes(content)
    with pytest.raises(PolicyError, match=rf"^--policy {kind}:{path}: .*{message}"):
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
