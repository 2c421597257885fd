"""Contract and normalisation of a LeRobot policy, read before its weights.

config.json gives shapes. Rate, names, units, frame and autopilot modes come from a contract file:
``adapters.interface``.

The policy's preprocessor and postprocessor normalise, by statistics in a state file beside
policy_preprocessor.json. All modes have one affine form.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from policy.adapters.interface import Interface, read_interface
from policy.adapters.lerobot.config import Config, Features, read_config, read_json
from policy.contract import ACTION_DIM, Contract, FloatArray
from policy.data.lerobot_format import ACTION_KEY, STATE_KEY
from policy.errors import CheckpointError, ContractError, warned
from policy.files import CONTRACT_FILE, open_safetensors

PREPROCESSOR, POSTPROCESSOR = "policy_preprocessor.json", "policy_postprocessor.json"
WEIGHTS_FILE = "model.safetensors"
MODES: dict[str, tuple[str, ...]] = {
    "IDENTITY": (),
    "MEAN_STD": ("mean", "std"),
    "MIN_MAX": ("min", "max"),
    "QUANTILES": ("q01", "q99"),
    "QUANTILE10": ("q10", "q90"),
}
"""Statistics that each normalisation mode needs."""
_HARMLESS = ("to_batch_processor", "device_processor")
_STEP = {
    "config": dict,
    "rename_map": dict | None,
    "norm_map": dict | None,
    "normalize_observation_keys": list | None,
    "eps": float | int | None,
    "state_file": str | None,
}
"""Types of the entries of a processor's step that are read; None: it may be missing or null."""
_EPSILON = 1e-8
_CONSTANT = 1e-6
"""A number of the state that varied by less counts as constant."""


@dataclass(frozen=True, kw_only=True)
class Affine:
    """``normalised = gain * (value - shift) / divisor - bias``, rounded as in LeRobot's own code.

    The inverse is ``(normalised + bias) / gain * span + shift``.
    """

    shift: FloatArray
    divisor: FloatArray
    span: FloatArray
    gain: float
    bias: float


@dataclass(frozen=True, kw_only=True)
class Normalisation:
    """Normalisation by an input's name in config.json, and of the action; None: unchanged."""

    images: Mapping[str, Affine | None]
    state: Affine | None
    action: Affine | None
    renamed: Mapping[str, str]
    """Name of an input in the data -> its name in config.json."""


@dataclass(frozen=True, kw_only=True)
class _Statistics:
    """Statistics by feature and name, and the normalisation mode of each kind of feature."""

    path: Path
    asked: Mapping[str, str]
    """Modes of config.json; a processor may have others."""
    modes: Mapping[str, str]
    epsilon: float
    arrays: Mapping[str, Mapping[str, FloatArray]]

    def affine(self, key: str, kind: str, size: int, notes: list[str]) -> Affine | None:
        """Return the transformation of a feature of ``size`` numbers or channels; None: unchanged,
        noted if it is asked for."""
        mode, own = str(self.modes.get(kind, "IDENTITY")), self.arrays.get(key, {})
        if mode not in MODES:
            raise CheckpointError(
                f"{self.path}: normalises {key} by {mode!r}; supported are {', '.join(MODES)}"
            )
        if mode == "IDENTITY" or not own:
            if self.asked.get(kind, "IDENTITY") != "IDENTITY":
                notes.append(warned(f"{self.path} holds no statistics of {key}: not normalised"))
            return None
        if missing := [name for name in MODES[mode] if name not in own]:
            raise CheckpointError(
                f"{self.path}: {key} is normalised by {mode}, but its statistics lack {missing}; "
                f"there are {sorted(own)}"
            )
        if sizes := {name: n for name in MODES[mode] if (n := own[name].size) != size}:
            raise CheckpointError(
                f"{self.path}: each statistic of {key} must have {size} numbers, got {sizes}"
            )
        shape = (3, 1, 1) if kind == "VISUAL" else (-1,)
        low, high = (own[name].astype(np.float32).reshape(shape) for name in MODES[mode])
        if not (np.isfinite(low).all() and np.isfinite(high).all()):
            raise CheckpointError(f"{self.path}: the statistics of {key} hold NaN or infinity")
        epsilon = np.float32(self.epsilon)
        if mode == "MEAN_STD":
            return Affine(shift=low, divisor=high + epsilon, span=high, gain=1.0, bias=0.0)
        span = np.where(high == low, epsilon, high - low)
        return Affine(shift=low, divisor=span, span=span, gain=2.0, bias=1.0)


def read_normalisation(folder: Path, features: Features) -> tuple[Normalisation, list[str]]:
    """Read a policy's normalisation, with notes for the user."""
    if not (folder / PREPROCESSOR).is_file():
        raise CheckpointError(
            f"{folder}: there is no {PREPROCESSOR}: copy the whole folder that LeRobot wrote; a "
            "policy of LeRobot before 0.4 is converted by its migrate_policy_normalization.py"
        )
    inputs, renamed = _processor(folder / PREPROCESSOR, "normalizer_processor", features)
    outputs, _ = _processor(folder / POSTPROCESSOR, "unnormalizer_processor", features)
    notes: list[str] = []
    width = features.state_dim
    state = inputs.affine(STATE_KEY, "STATE", width, notes) if width else None
    if state is not None and (constant := np.flatnonzero(state.divisor < _CONSTANT).tolist()):
        told = f"numbers {constant} (from 0) of {STATE_KEY} never changed in the training data"
        notes.append(
            warned(f"{told}: as in LeRobot, any other value is divided by almost 0 and dominates")
        )
    normalisation = Normalisation(
        images={key: inputs.affine(key, "VISUAL", 3, notes) for key in features.image_keys},
        state=state,
        action=outputs.affine(ACTION_KEY, "ACTION", ACTION_DIM, notes),
        renamed=renamed,
    )
    return normalisation, notes


def _processor(
    path: Path, normaliser: str, features: Features
) -> tuple[_Statistics, dict[str, str]]:
    """Read the steps of a processor: at most one normalisation, and renamings."""
    renamed: dict[str, str] = {}
    found = _Statistics(path=path, asked=features.modes, modes={}, epsilon=0.0, arrays={})
    steps = read_json(path).get("steps")
    if not isinstance(steps, list) or not all(isinstance(step, dict) for step in steps):
        raise CheckpointError(f"{path}: no list of steps")
    for step in steps:
        name, config = step.get("registry_name", step.get("class")), step.get("config", {})
        entries = {"config": config, **step, **(config if isinstance(config, dict) else {})}
        if wrong := [key for key, kind in _STEP.items() if not isinstance(entries.get(key), kind)]:
            raise CheckpointError(f"{path}: the step {name!r} has malformed entries {wrong}")
        if name == "rename_observations_processor":
            renamed |= config.get("rename_map") or {}
        elif name == normaliser:
            file, only = step.get("state_file"), config.get("normalize_observation_keys")
            arrays = _by_feature(_read_arrays(path.parent / file)) if file else {}
            kept = {k: v for k, v in arrays.items() if only is None or k in (*only, ACTION_KEY)}
            modes, epsilon = config.get("norm_map") or {}, config.get("eps")
            epsilon = _EPSILON if epsilon is None else float(epsilon)
            found = replace(found, modes=modes, epsilon=epsilon, arrays=kept)
        elif name not in _HARMLESS:
            raise CheckpointError(
                f"{path}: the step {name!r} is not supported: serve the policy from its own "
                "environment, and fly --policy ws://HOST:PORT"
            )
    return found, renamed


def _by_feature(arrays: Mapping[str, FloatArray]) -> dict[str, dict[str, FloatArray]]:
    """Group entries such as ``observation.state.mean`` by feature, then by statistic."""
    found: dict[str, dict[str, FloatArray]] = {}
    for name, array in arrays.items():
        key, _, statistic = name.rpartition(".")
        found.setdefault(key, {})[statistic] = array
    return found


def _read_arrays(path: Path) -> dict[str, FloatArray]:
    if not path.is_file():
        raise CheckpointError(f"{path} is missing: copy the whole folder that LeRobot wrote")
    with open_safetensors(path, "numpy") as file:
        return {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a dict


@dataclass(frozen=True, kw_only=True)
class Plan:
    """A policy without its weights."""

    folder: Path
    config: Config
    normalisation: Normalisation
    interface: Interface
    """Its contract is complete: config.json's values are merged in."""
    policy_cameras: tuple[int, ...]
    """Index of each camera of the contract in ``config.features.image_keys``."""
    notes: tuple[str, ...]


def read_plan(folder: Path, contract_file: Path | None) -> Plan:
    """Read everything but the weights; takes milliseconds and needs no torch."""
    config, notes = read_config(folder)
    if not (folder / WEIGHTS_FILE).is_file():
        raise CheckpointError(f"{folder / WEIGHTS_FILE} is missing: copy the whole folder")
    normalisation, more_notes = read_normalisation(folder, config.features)
    path = contract_file or folder / CONTRACT_FILE
    if not path.is_file():
        raise ContractError(
            f"{path}: no such file. A LeRobot folder does not say at which rate it was trained, "
            "nor what its state and action mean: mavbridge contract "
            f"{folder} writes a first draft there, or name a file by --contract FILE.toml"
        )
    interface = _interface(path, config)
    _require_state(path, interface, config.features)
    return Plan(
        folder=folder,
        config=config,
        normalisation=normalisation,
        interface=interface,
        policy_cameras=_policy_cameras(path, interface, config.features, normalisation),
        notes=(*notes, *more_notes),
    )


def _interface(path: Path, config: Config) -> Interface:
    """Return the completed contract file: images in [0, 1] as in LeRobot, the rest by config.json.

    Observations are spaced like actions: LeRobot takes both from the frames of a dataset.
    """
    derived: dict[str, object] = {
        "arrays": "torch",
        "image_height": config.features.image_height,
        "image_width": config.features.image_width,
        "image_mean_rgb": (0.0, 0.0, 0.0),
        "image_std_rgb": (1.0, 1.0, 1.0),
        "feature_dim": config.feature_dim,
        "observation_steps": config.n_obs_steps,
        "horizon": config.horizon,
        "prefix_len": 0,
    }
    interface = read_interface(path, derived)
    contract: Contract = interface.contract
    if contract.observation_dt_s not in (Contract.observation_dt_s, contract.chunk_dt_s):
        raise ContractError(
            f"{path}: [contract] observation_dt_s = {contract.observation_dt_s}: LeRobot's "
            f"observations are chunk_dt_s = {contract.chunk_dt_s} apart: leave it out"
        )
    return replace(interface, contract=replace(contract, observation_dt_s=contract.chunk_dt_s))


def _require_state(path: Path, interface: Interface, features: Features) -> None:
    names = interface.state_names or interface.contract.state_names
    if features.state_dim is not None and interface.state_dim != features.state_dim:
        raise ContractError(
            f"{path}: the policy takes a state of {features.state_dim} numbers, and these are "
            f"{len(names)}: {', '.join(names)}. Name its numbers in their order: [state] names"
        )
    if features.state_dim is not None and interface.state_key != STATE_KEY:
        raise ContractError(
            f"{path}: [state] key is {interface.state_key!r}, LeRobot's is {STATE_KEY!r}"
        )


def _policy_cameras(
    path: Path, interface: Interface, features: Features, normalisation: Normalisation
) -> tuple[int, ...]:
    known = features.image_keys
    keys = [str(normalisation.renamed.get(key, key)) for key in interface.camera_keys]
    if not interface.image_keys and len(known) == len(keys) == 1:
        return (0,)  # one camera on both sides: names do not matter
    if sorted(keys) != sorted(known):
        raise ContractError(
            f"{path}: the policy's images are {list(known)}, the contract's are {keys}; name all "
            'cameras in [contract] cameras = [...], and in [images] NAME = "KEY" the policy\'s '
            "key of each"
        )
    return tuple(known.index(key) for key in keys)
