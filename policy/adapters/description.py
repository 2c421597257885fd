"""Description of an exported policy, beside its graphs or inside them: docs/policy_exported.md.

A contract file (``interface``) replaces the ``contract`` in it.
"""

import json
import zipfile
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from policy.adapters.interface import CONTRACT_FILE, Interface, read_interface
from policy.contract import Contract
from policy.errors import CheckpointError, PolicyError
from policy.files import parse_json, why_unreadable

DESCRIPTION = "policy.json"
ROLES = ("image", "feature", "state", "action_history", "noisy", "timestep")
"""Roles of a graph's inputs."""
USUAL_NAMES: dict[str, tuple[str, ...]] = {
    "image": ("image", "images", "rgb", "pixels"),
    "feature": ("feature", "features", "global_cond"),
    "state": ("state", "proprio", "obs", "observation", "observations"),
    "action_history": ("action_history", "history"),
    "noisy": ("noisy", "noisy_action", "noisy_actions", "sample"),
    "timestep": ("timestep", "timesteps", "t"),
}
"""Input names that are recognised without an entry in the description."""
RESULTS = ("chunk", "feature", "prediction")
"""Results of a graph: of a policy or head, an encoder, a denoiser."""
TABLES = ("contract", "schedule", "inputs", "outputs", "hidden")


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
    for name, known in (("inputs", ROLES), ("outputs", RESULTS)):
        if unknown := sorted(set(rest[name]) - set(known)):
            raise CheckpointError(f"{where}: {name} {unknown} are unknown; known are {list(known)}")
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
    try:
        data: Any = parse_json(text)
    except ValueError as error:
        raise CheckpointError(f"{where} is not JSON: {error}") from error
    if not isinstance(data, dict) or not set(data) <= set(TABLES):
        there = sorted(data) if isinstance(data, dict) else type(data).__name__
        raise CheckpointError(f"{where} must be an object of {list(TABLES)}, not {there}")
    if wrong := [name for name, value in data.items() if not isinstance(value, dict)]:
        raise CheckpointError(f"{where}: {wrong} must be objects")
    return data


def read_description(spec: str, path: Path, contract_file: Path | None) -> Description:
    """Read the description inside the archive of the policy ``spec``; takes milliseconds."""
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
            extra = [name for name in names if name.endswith(f"/extra/{DESCRIPTION}")]
            text = archive.read(extra[0]).decode() if extra else None
    except (OSError, zipfile.BadZipFile, zlib.error, RuntimeError, EOFError, ValueError) as error:
        raise CheckpointError(f"--policy {spec}: {why_unreadable(path, error)}") from error
    if not any("/code/" in name for name in names):
        raise CheckpointError(
            f"--policy {spec}: {path} is not a TorchScript archive: write it with "
            "torch.jit.script(module).save(FILE), or torch.jit.trace"
        )
    where = path / DESCRIPTION
    return describe(spec, text, where=where, beside=path.parent, contract_file=contract_file)
