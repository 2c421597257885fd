"""Files of an ONNX policy, by the names that docs/policy_exported.md lists."""

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

_EXTERNAL = re.compile(r"externally stored data in file \((.+), offset: ")
"""In an error of OpenVINO: the file whose external weights are missing."""


@dataclass(frozen=True, kw_only=True)
class OnnxFiles:
    """Paths of a policy's graphs, and its description."""

    description: Description
    encoder: Path | None
    """None if ``rest`` is the whole policy."""
    rest: Path
    """Denoiser, head, or whole policy."""

    @property
    def is_denoiser(self) -> bool:
        """True if ``rest`` is one step of a diffusion policy."""
        return self.rest.name == DENOISER and self.encoder is not None


def find_onnx_files(spec: str, path: Path, contract_file: Path | None) -> OnnxFiles:
    """Read everything of the policy ``spec`` except its graphs; takes milliseconds."""
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
    """Read an ONNX file and its external weights."""
    from openvino import frontend  # not needed to find the files

    # The ONNX frontend alone: otherwise the parsers of all formats add their errors.
    reader = frontend.FrontEndManager().load_by_framework("onnx")
    failures = (
        *(RuntimeError, frontend.GeneralFailure, frontend.OpConversionFailure),
        *(frontend.OpValidationFailure, frontend.NotImplementedFailure),
    )
    try:
        loaded = reader.load(str(path))
    except failures as error:
        if (found := _EXTERNAL.search(str(error))) is None:
            raise CheckpointError(why_unreadable(path, error, "ONNX")) from error
        beside = path.parent / found[1]
        what, advice = stand_in(beside) or ("missing or cut short", "copy both files again")
        raise CheckpointError(
            f"{beside}, which holds the weights of {path.name}, is {what}: {advice}"
        ) from error
    try:
        model: ov.Model = reader.convert(loaded)
    except failures as error:
        raise CheckpointError(
            f"{path} holds what OpenVINO cannot run ({last_line(error)}): export it with operators "
            "of the ONNX standard alone, and without errors of onnx.checker"
        ) from error
    if not model.outputs:
        raise CheckpointError(why_unreadable(path, ValueError("there is no graph in it"), "ONNX"))
    return model
