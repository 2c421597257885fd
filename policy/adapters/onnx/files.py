"""The files of a policy in ONNX.

DIR/encoder.onnx     image -> feature; with it the policy flies at two rates
DIR/denoiser.onnx    noisy, timestep, feature, state, action_history -> prediction: one step of
                     a diffusion policy; the loop is ours
DIR/head.onnx        in its place: feature, state, action_history -> chunk
DIR/policy.onnx      alone, or one file instead of a folder: image, state, action_history ->
                     chunk
DIR/policy.json      as ``description`` says; a denoiser needs its schedule
DIR/mavbridge.toml   the contract, as of --contract, where policy.json has none
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from policy.adapters.description import DESCRIPTION, Description, describe
from policy.errors import CheckpointError
from policy.files import last_line, read_text, stand_in, why_unreadable

if TYPE_CHECKING:
    import openvino as ov

ENCODER, DENOISER, HEAD, WHOLE = "encoder.onnx", "denoiser.onnx", "head.onnx", "policy.onnx"
KINDS = f"{ENCODER} and {DENOISER}, {ENCODER} and {HEAD}, or {WHOLE} alone"

_EXTERNAL = re.compile(rb"\x0a\x08location\x12([\x01-\x7f])(.{0,127})", re.DOTALL)
_OFFSET, _LENGTH = (
    re.compile(rb"\x0a\x06" + key + rb"\x12[\x01-\x14](\d+)") for key in (b"offset", b"length")
)
"""Entries of ``TensorProto.external_data`` (onnx.proto): a key and its value, both texts."""
_GRAPH_FIELD = 7
"""Of ONNX's ModelProto."""


@dataclass(frozen=True, kw_only=True)
class OnnxFiles:
    """Where the graphs of a policy lie, and its description."""

    description: Description
    encoder: Path | None
    """None where ``rest`` is the whole policy."""
    rest: Path
    """The denoiser, the head, or the whole policy."""

    @property
    def is_denoiser(self) -> bool:
        """``rest`` is one step of a diffusion policy."""
        return self.rest.name == DENOISER and self.encoder is not None


def find_onnx_files(spec: str, path: Path, contract_file: Path | None) -> OnnxFiles:
    """Read everything but the graphs of the policy ``spec``: milliseconds."""
    if not path.exists():
        raise CheckpointError(f"--policy {spec}: there is no such file or folder")
    folder = path if path.is_dir() else path.parent
    encoder, rest = _graphs(spec, path)
    where = folder / DESCRIPTION
    try:
        text = read_text(where) if where.is_file() else None
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{where} cannot be read: {error}") from error
    description = describe(spec, text, where=where, beside=folder, contract_file=contract_file)
    files = OnnxFiles(description=description, encoder=encoder, rest=rest)
    if files.is_denoiser and not description.schedule:
        raise CheckpointError(
            f"{where}: a {DENOISER} needs the noise schedule of its training: "
            '{"schedule": {"num_train_timesteps": 100, "betas": "squared_cosine", '
            '"prediction": "epsilon"}}'
        )
    return files


def _graphs(spec: str, path: Path) -> tuple[Path | None, Path]:
    if path.is_file():
        if path.suffix != ".onnx":
            raise CheckpointError(f"--policy {spec}: not a .onnx file; give {KINDS}")
        return None, path
    encoder, denoiser, head, whole = (path / name for name in (ENCODER, DENOISER, HEAD, WHOLE))
    if encoder.is_file() and denoiser.is_file() != head.is_file():
        return encoder, denoiser if denoiser.is_file() else head
    if whole.is_file() and not encoder.is_file():
        return None, whole
    there = sorted(each.name for each in path.glob("*.onnx"))
    raise CheckpointError(f"--policy {spec}: the folder must hold {KINDS}; it holds {there}")


def read_graph(path: Path) -> "ov.Model":
    """Read an ONNX file and the files of its weights."""
    from openvino import Core  # not needed to find the files

    _require_external_data(path)
    if not _is_whole(path.read_bytes()):  # else parsers of all formats tell what they think of it
        error = ValueError("it is something else, or breaks off")
        raise CheckpointError(why_unreadable(path, error, "ONNX"))
    try:
        return Core().read_model(path)
    except RuntimeError as error:
        raise CheckpointError(
            f"{path} holds what OpenVINO cannot run ({last_line(error)}): export it with operators "
            "of the ONNX standard alone, and without errors of onnx.checker"
        ) from error


def _is_whole(content: bytes) -> bool:
    """Return whether these are fields of a protobuf message, whole, with a graph (7) among them."""
    at, numbers = 0, set()
    try:
        while at < len(content):
            key, at = _varint(content, at)
            numbers.add(key >> 3)
            match key & 7:
                case 0:
                    _, at = _varint(content, at)
                case 2:
                    size, at = _varint(content, at)
                    at += size
                case 1 | 5 as kind:
                    at += 8 if kind == 1 else 4
                case _:
                    return False
    except IndexError:
        return False
    return at == len(content) and _GRAPH_FIELD in numbers


def _varint(content: bytes, at: int) -> tuple[int, int]:
    """Read a number of protobuf; returns it, and where the next field begins."""
    value = shift = 0
    while True:
        byte = content[at]
        value, at, shift = value | (byte & 0x7F) << shift, at + 1, shift + 7
        if not byte & 0x80:
            return value, at


def _require_external_data(path: Path) -> None:
    """Raise CheckpointError if a file with tensors of the graph is missing or too short."""
    content = path.read_bytes()
    needed: dict[str, int] = {}
    for found in _EXTERNAL.finditer(content):
        name = found[2][: found[1][0]].decode(errors="replace")
        entry = content[found.end(1) : found.end(1) + found[1][0] + 80]
        entry = entry.partition(b"\x0a\x08location")[0]  # of the next tensor
        ends = [int(each[1]) if (each := key.search(entry)) else 0 for key in (_OFFSET, _LENGTH)]
        needed[name] = max(needed.get(name, 0), sum(ends))
    for name, size in needed.items():
        beside = path.parent / name
        if not beside.is_file():
            raise CheckpointError(
                f"{path}: {name} is missing beside it, and holds its weights: copy both files"
            )
        has = beside.stat().st_size
        if has < size:
            what, advice = stand_in(beside) or ("cut short", "copy it again")
            raise CheckpointError(
                f"{beside} is {what} ({has} bytes, {path.name} needs {size}): {advice}"
            )
