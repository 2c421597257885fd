"""Files of an exported policy except its networks: graphs by name, and the description.

The description is beside the graphs or inside an archive: docs/policy_exported.md. A contract file
(``interface``) replaces the ``contract`` in it.
"""

import json
import re
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from policy.adapters.interface import Interface, read_interface
from policy.contract import Contract
from policy.errors import CheckpointError, PolicyError
from policy.files import (
    CONTRACT_FILE,
    decode_text,
    last_line,
    parse_object,
    read_text,
    stand_in,
    why_unreadable,
)

if TYPE_CHECKING:
    import openvino as ov

DESCRIPTION = "policy.json"
USUAL_NAMES: dict[str, tuple[str, ...]] = {
    "image": ("image", "images", "rgb", "pixels"),
    "feature": ("feature", "features", "global_cond"),
    "state": ("state", "proprio", "obs", "observation", "observations"),
    "action_history": ("action_history", "history"),
    "noisy": ("noisy", "noisy_action", "noisy_actions", "sample"),
    "timestep": ("timestep", "timesteps", "t"),
}
"""Names of a graph's inputs by their role, recognised without an entry in the description."""
RESULTS = ("chunk", "feature", "prediction")
"""Results of a graph: of a policy or head, an encoder, a denoiser."""
TABLES = ("contract", "schedule", "inputs", "outputs", "hidden")
ENCODER, DENOISER, HEAD, WHOLE = "encoder.onnx", "denoiser.onnx", "head.onnx", "policy.onnx"
KINDS = f"{ENCODER} and {DENOISER}, {ENCODER} and {HEAD}, or {WHOLE} alone"
_EXTERNAL = re.compile(
    r"(?:externally stored data in file \(|data_full_path: )(.+), offset: |"
    r"resolves to '(.+)' which is outside the base directory",
    re.S,
)
"""In an error of OpenVINO: the file of external weights that is missing, or is elsewhere."""


def is_ordered(names: Sequence[str], roles: Sequence[str]) -> bool:
    """True unless an argument has the usual name of a different role."""
    places = {name: at for at, role in enumerate(roles) for name in USUAL_NAMES[role]}
    return all(places.get(name, at) == at for at, name in enumerate(names))


@dataclass(frozen=True, kw_only=True)
class Description:
    """Contract, noise schedule and port names of an exported policy."""

    interface: Interface
    schedule: dict[str, Any] = field(default_factory=dict)
    """Fields of ``nets.diffusion.NoiseSchedule``; empty: not given."""
    inputs: dict[str, str] = field(default_factory=dict)
    """Name of an input by its role."""
    outputs: dict[str, str | int] = field(default_factory=dict)
    """Name of an output, or its index in a tuple, by its result."""
    hidden: dict[str, str] = field(default_factory=dict)
    """Output that feeds each hidden input at the next call, by name."""


def describe(
    spec: str, text: str | None, *, where: Path, beside: Path, contract_file: Path | None
) -> Description:
    """Combine everything that is known of the policy ``spec``.

    ``text`` is the optional JSON of this module's docstring, read from ``where``. The contract
    comes from ``contract_file``, else from the text, else from mavbridge.toml in the folder
    ``beside``.
    """
    data = {} if text is None else _parsed(where, text)
    rest = {name: data.get(name, {}) for name in TABLES if name != "contract"}
    for name, known in (("inputs", USUAL_NAMES), ("outputs", RESULTS)):
        if unknown := sorted(set(rest[name]) - set(known)):
            raise CheckpointError(f"{where}: {name} {unknown} are unknown; known are {list(known)}")
    for name in ("inputs", "outputs", "hidden"):
        if wrong := {k: v for k, v in rest[name].items() if not isinstance(v, str | int)}:
            raise CheckpointError(f"{where}: {name} must be single names, got {wrong}")
    if contract_file is not None:
        return Description(interface=read_interface(contract_file), **rest)
    if "contract" in data:
        try:
            contract = Contract.from_json(json.dumps(data["contract"]))
        except PolicyError as error:
            raise CheckpointError(f"{where}: {error}") from error
        return Description(interface=Interface(contract=contract), **rest)
    if (beside / CONTRACT_FILE).is_file():
        return Description(interface=read_interface(beside / CONTRACT_FILE), **rest)
    raise CheckpointError(
        f"--policy {spec}: nothing says at which rate and in which units it flies: give "
        f"--contract FILE.toml, or put {CONTRACT_FILE} beside it"
    )


def _parsed(where: Path, text: str) -> dict[str, dict[str, Any]]:
    data = parse_object(text, CheckpointError, str(where))
    if not set(data) <= set(TABLES):
        raise CheckpointError(f"{where} must be an object of {list(TABLES)}, not {sorted(data)}")
    if wrong := [name for name, value in data.items() if not isinstance(value, dict)]:
        raise CheckpointError(f"{where}: {wrong} must be objects")
    return data


def read_description(spec: str, path: Path, contract_file: Path | None) -> Description:
    """Read the description inside the archive of the policy ``spec``; takes milliseconds."""
    names, data = [], None
    try:
        with path.open("rb") as file:
            is_pickle = file.read(1) == b"\x80"  # also what torch.save wrote once
        if not is_pickle:
            with zipfile.ZipFile(path) as archive:
                names = archive.namelist()
                extra = [name for name in names if name.endswith(f"/extra/{DESCRIPTION}")]
                data = archive.read(extra[0]) if extra else None
    except (OSError, zipfile.BadZipFile, zlib.error, RuntimeError, EOFError, ValueError) as error:
        raise CheckpointError(f"--policy {spec}: {why_unreadable(path, error)}") from error
    if not any("/code/" in name for name in names):
        raise CheckpointError(
            f"--policy {spec}: {path} is not a TorchScript archive: write it with "
            "torch.jit.script(module).save(FILE), or torch.jit.trace"
        )
    where = path / DESCRIPTION
    try:
        text = None if data is None else decode_text(data)
    except ValueError as error:
        raise CheckpointError(f"{where} cannot be read: {error}") from error
    return describe(spec, text, where=where, beside=path.parent, contract_file=contract_file)


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
        if path.suffix.lower() != ".onnx":
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
        said = _lacking(path, error) or why_unreadable(path, error, "ONNX")
        raise CheckpointError(said) from error
    try:
        model: ov.Model = reader.convert(loaded)
    except failures as error:
        said = _lacking(path, error) or (
            f"{path} holds what OpenVINO cannot run ({last_line(error)}): export it with operators "
            "of the ONNX standard alone, and without errors of onnx.checker"
        )
        raise CheckpointError(said) from error
    if not model.outputs:
        raise CheckpointError(why_unreadable(path, ValueError("there is no graph in it"), "ONNX"))
    return model


def _lacking(path: Path, error: Exception) -> str | None:
    """Return what is wrong with a graph's external weights if that is why it was not read."""
    if (found := _EXTERNAL.search(str(error))) is None:
        return None
    beside = path.parent / (found[1] or found[2])
    what, advice = stand_in(beside) or ("missing or cut short", "copy both files again")
    if found[2]:
        what, advice = "in another folder", "put both files themselves, not links, into one folder"
    return f"{beside}, which holds the weights of {path.name}, is {what}: {advice}"
