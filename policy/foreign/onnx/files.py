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

from dataclasses import dataclass
from pathlib import Path

from policy.errors import CheckpointError
from policy.files import read_text
from policy.foreign.description import DESCRIPTION, Description, describe

ENCODER, DENOISER, HEAD, WHOLE = "encoder.onnx", "denoiser.onnx", "head.onnx", "policy.onnx"
KINDS = f"{ENCODER} and {DENOISER}, {ENCODER} and {HEAD}, or {WHOLE} alone"


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
    """Read everything but the graphs of the policy ``spec``: milliseconds.

    Raises:
        PolicyError: a file is missing or malformed, or nothing says what the contract is.
    """
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
