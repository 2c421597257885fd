"""What a file or folder is that was given as a policy's weights and is not ours.

Everything is read by hand: no torch, and no pickle is executed.
"""

import io
import json
import pickletools
import struct
import zipfile
import zlib
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from policy.files import open_regular, read_json, stand_in_of

HEAD_BYTES = 4096
MAX_HEADER_BYTES = 100_000_000
"""Longest header of safetensors, as its own reader has it."""
MAX_PICKLE_BYTES = 16_000_000
MAX_PICKLES = 4
OWN_CLASS = (
    "write a class that loads it (--policy ./file.py:Class, with --checkpoint for the file), or "
    "let a server run it (--policy ws://HOST:PORT)"
)
LEROBOT_TYPES = ("act", "diffusion")
"""Types of LeRobot policies that fly from their files."""
_MAGIC: tuple[tuple[int, bytes, str, str], ...] = (
    (0, b"\x89HDF\r\n", "an HDF5 file (Keras weights, or data of robomimic)", OWN_CLASS),
    (0, b"GGUF", "a quantised model for llama.cpp (GGUF)", OWN_CLASS),
    (4, b"TFL3", "a TensorFlow Lite model", OWN_CLASS),
    (0, b"PAR1", "a Parquet table, not weights", "name the file of the policy"),
    (0, b"\x1f\x8b", "a compressed archive (gzip)", "unpack it, and name what is in it"),
    (0, b"\x28\xb5\x2f\xfd", "a compressed archive (zstd)", "unpack it, and name what is in it"),
    (257, b"ustar", "an archive (tar)", "unpack it, and name what is in it"),
)
"""Offset, bytes there, what that is, what to do."""
_PREFACE = ("PROTO", "FRAME", "MARK", "MEMOIZE", "PUT", "BINPUT", "LONG_BINPUT")
"""Opcodes that come before, or between, those that say what is pickled."""
_SIGNS: tuple[tuple[str, str, str], ...] = (
    ("meta/info.json", "a LeRobot data set, not a policy", "train one: mavbridge train {}"),
    ("ticks.parquet", "a recorded flight, not a policy", "train one: mavbridge train {}"),
    ("adapter_config.json", "a LoRA adapter, not a whole policy", "merge it into its model first"),
    ("*.onnx", "a folder of ONNX models", "fly it with --policy onnx:{}"),
    ("__init__.py", "a Python package", "name a class in it: --policy package:Class"),
    ("saved_model.pb", "a TensorFlow model", OWN_CLASS),
    ("_METADATA", "a JAX checkpoint (Orbax)", OWN_CLASS),
    (".metadata", "a distributed checkpoint of torch", OWN_CLASS),
)
"""File in a folder, what the folder is, what to do."""
_TENSOR_MODULES = ("torch", "torch._utils", "torch.nn.parameter", "torch.serialization")
_PLAIN_MODULES = ("collections", "_codecs", "builtins", "__builtin__", "copyreg", "copy_reg")


def detect(path: Path) -> str | None:
    """What ``path`` is and how it flies, if it is known and no checkpoint of ours; else None."""
    try:
        found = _folder(path) if path.is_dir() else _file(path)
    except OSError:
        return None  # whoever opens it says why it cannot be read
    if found is None:
        return None
    what, advice = found
    return f"{path} is {what}: {advice}"


def _file(path: Path) -> tuple[str, str] | None:
    with open_regular(path) as file:
        head = file.read(HEAD_BYTES)
    if (found := stand_in_of(head)) is not None:
        return found
    if head.lstrip().startswith(b"<?xml") and b"<net " in head.lower():
        return "an OpenVINO model", f"fly the ONNX file that it was made of, or {OWN_CLASS}"
    for offset, magic, what, advice in _MAGIC:
        if head[offset : offset + len(magic)] == magic:
            return what, advice
    if head.startswith(b"PK\x03\x04"):
        return _zip(path)
    if head[8:9] == b"{":
        return _safetensors(path)
    if head.startswith(b"\x80"):
        with open_regular(path) as file:
            return _pickle(path, file.read(MAX_PICKLE_BYTES))
    if path.suffix == ".onnx":
        return "an ONNX model", f"fly it with --policy onnx:{path}"
    return None


def _zip(path: Path) -> tuple[str, str] | None:
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
            inner = {name.partition("/")[2] for name in names}
            if "constants.pkl" in inner or any(name.startswith("code/") for name in inner):
                return "a TorchScript archive", f"fly it with --policy torchscript:{path}"
            if {"archive_format", "serialized_exported_program.json"} & (inner | set(names)):
                return (
                    "a program of torch.export",
                    "export it as ONNX (torch.onnx.export) and fly it with --policy onnx:FILE",
                )
            if names and all(name.endswith(".npy") for name in names):
                return "a file of numpy arrays", OWN_CLASS
            pickled = next((name for name in names if name.endswith("data.pkl")), None)
            if pickled is None:
                return "a zip archive", "unpack it, and name what is in it"
            with archive.open(pickled) as file:
                return _pickle(path, file.read(MAX_PICKLE_BYTES))
    except (
        zipfile.BadZipFile,
        zlib.error,
        NotImplementedError,
        RuntimeError,
        EOFError,
        ValueError,
    ):
        return "cut short, or damaged", "copy or download it again, and compare its size"


def _pickle(path: Path, content: bytes) -> tuple[str, str] | None:
    """What a pickle would need to be read as, by its opcodes; None where tensors alone will do."""
    names, is_object = _globals_of(content)
    classes = [
        f"{module}.{name}"
        for module, name in names
        if module not in (*_TENSOR_MODULES, *_PLAIN_MODULES)
    ]
    modules = [name for name in classes if name.startswith("torch.nn.")]
    if ("torch._utils", "_rebuild_qtensor") in names or _quantised(classes):
        return (
            "a quantised network",
            "save the state_dict of the one with floating-point weights; the engines here round to "
            "bf16 by themselves where the machine gains by it",
        )
    if is_object and classes:
        return (
            f"a whole pickled object ({classes[0]}), and loading that could run any program",
            "where it was trained, save model.state_dict() for a network of this project; for "
            "another one save torch.jit.trace(model, example) (--policy torchscript:FILE) or write "
            "a class that builds it (--policy ./file.py:Class)",
        )
    if modules:
        return (
            f"a dictionary with whole pickled modules ({modules[0]} among them), and loading those "
            "could run any program",
            "save model.state_dict() in place of the model where it was trained",
        )
    if classes:
        return (
            f"weights with other pickled objects beside them ({', '.join(classes[:3])}), and "
            "loading those could run any program",
            "where you trust it, save the weights alone: torch.save({'state_dict': "
            f"torch.load('{path.name}', weights_only=False)['state_dict']}}, 'weights.pt')",
        )
    return None


def _quantised(classes: Sequence[str]) -> bool:
    return any(
        name.startswith(("torchao.", "bitsandbytes.", "torch.ao.", "torch.quantization."))
        for name in classes
    )


def _globals_of(content: bytes) -> tuple[list[tuple[str, str]], bool]:
    """(module, name) of everything that pickles would look up, and whether one of them begins so.

    Old files of torch are four pickles in a row. A damaged one gives what comes before the damage.
    """
    found: list[tuple[str, str]] = []
    has_object = False
    stream = io.BytesIO(content)
    with suppress(Exception):  # pickletools raises whatever the bytes lead it to
        for _ in range(MAX_PICKLES):
            texts: list[str] = []
            is_first = True
            for opcode, argument, _ in pickletools.genops(stream):
                before = len(found)
                if opcode.name in ("GLOBAL", "INST"):
                    module, _, name = str(argument).partition(" ")
                    found.append((module, name))
                elif opcode.name == "STACK_GLOBAL" and len(texts) >= 2:
                    found.append((texts[-2], texts[-1]))
                elif isinstance(argument, str):
                    texts.append(argument)
                    continue
                elif opcode.name in _PREFACE:
                    continue
                if is_first and len(found) > before:
                    has_object = has_object or found[-1][0] not in _PLAIN_MODULES
                is_first = False
    return found, has_object


def _safetensors(path: Path) -> tuple[str, str] | None:
    with open_regular(path) as file:
        (length,) = struct.unpack("<Q", file.read(8))
        text = file.read(min(length, MAX_HEADER_BYTES))
    try:
        header: Any = json.loads(text)
        metadata, tensors = header.pop("__metadata__", {}) or {}, header
        dtypes = [str(entry["dtype"]) for entry in tensors.values()]
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None  # its reader says what is wrong with it
    if "contract" in metadata:
        return None
    names = [str(name) for name in tensors]
    if (beside := _config_kind(path.parent)) is not None:
        what, advice = beside
        return f"the weights of {what}", advice
    if any(
        name.startswith(("diffusion.unet.", "model.action_head.", "normalize_inputs."))
        for name in names
    ):
        return (
            "the weights of a LeRobot policy, without the config.json that belongs beside them",
            "name the whole folder: --policy lerobot:DIR",
        )
    if any("lora_" in name for name in names):
        return "a LoRA adapter, not a whole policy", "merge it into its model first"
    if names and all("exp_avg" in name or name.startswith("optimizer") for name in names):
        return "the state of an optimiser, without weights", "name the file of the weights"
    small = [kind for kind in dtypes if kind in ("I8", "U8") or kind.startswith(("F8", "F4"))]
    if len(small) * 4 > len(dtypes) or any(name.endswith(".qweight") for name in names):
        return "a quantised network", "take the file with floating-point weights"
    return None


def _folder(path: Path) -> tuple[str, str]:
    if (kind := _config_kind(path)) is not None:
        return kind
    for inner in ("pretrained_model", "checkpoints/last/pretrained_model"):
        if (path / inner).is_dir():
            return "a folder of LeRobot's training", f"fly it with --policy lerobot:{path / inner}"
    for sign, what, advice in _SIGNS:
        if any(path.glob(sign)):
            return what, advice.replace("{}", str(path))
    there = sorted(each.name for each in path.iterdir())[:8]
    return "a folder", f"name a file; it holds {there}"


def _config_kind(folder: Path) -> tuple[str, str] | None:
    """What the configuration in a folder says that it holds, and what to do with that."""
    if (folder / "model_index.json").is_file():
        return "a pipeline of diffusers", OWN_CLASS
    try:
        config: Any = read_json(folder / "config.json")
    except (OSError, ValueError):
        return None
    if not isinstance(config, dict):
        return None
    if "type" in config and ("input_features" in config or "output_features" in config):
        kind = config["type"]
        if kind in LEROBOT_TYPES:
            return f"a LeRobot policy ({kind})", f"fly its folder with --policy lerobot:{folder}"
        return (
            f"a LeRobot policy of type {kind!r}",
            f"of its types {' and '.join(LEROBOT_TYPES)} fly from their files; run this one in "
            "LeRobot's own environment behind --policy ws://HOST:PORT",
        )
    if "_class_name" in config:
        return f"a model of diffusers ({config['_class_name']})", OWN_CLASS
    if "model_type" in config or "architectures" in config:
        return f"a Hugging Face model ({config.get('model_type', 'transformers')})", OWN_CLASS
    return None
