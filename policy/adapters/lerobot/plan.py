"""All that is known of a LeRobot policy before its weights are read: its networks and its contract.

config.json says shapes; what it does not say (rate, names, units, frame, autopilot modes) comes
from a contract file: ``adapters.interface``.
"""

from dataclasses import dataclass, replace
from pathlib import Path

from policy.adapters.interface import CONTRACT_FILE, Interface, read_interface
from policy.adapters.lerobot.config import STATE_KEY, Config, Features, read_config
from policy.adapters.lerobot.statistics import WEIGHTS_FILE, Normalisation, read_normalisation
from policy.contract import EXTRA_NAMES, Contract
from policy.errors import CheckpointError, ContractError


@dataclass(frozen=True, kw_only=True)
class Plan:
    """A policy without its weights."""

    folder: Path
    config: Config
    normalisation: Normalisation
    interface: Interface
    """Its contract is complete: what config.json says is in it."""
    policy_cameras: tuple[int, ...]
    """Place among ``config.features.image_keys`` of each camera of the contract."""
    notes: tuple[str, ...]


def read_plan(folder: Path, contract_file: Path | None) -> Plan:
    """Read everything but the weights: milliseconds, and no torch."""
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
    """The contract file, completed: images as LeRobot takes them, [0, 1], all else by config.json.

    Observations lie as far apart as actions: LeRobot takes both from the frames of a dataset.
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
    }
    interface = read_interface(path, derived)
    contract: Contract = interface.contract
    if config.features.takes_goal and "goal" not in contract.state_extras:
        contract = replace(contract, state_extras=(*contract.state_extras, "goal"))
    if config.features.takes_goal and not interface.state_names:
        own = tuple(name for name in contract.state_names if name not in EXTRA_NAMES["goal"])
        interface = replace(interface, contract=contract, state_names=own)
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
    if not known:
        return ()
    keys = [normalisation.renamed.get(key, key) for key in interface.camera_keys]
    if not interface.image_keys and len(known) == len(keys) == 1:
        return (0,)  # one camera there and one here, whatever they are called
    if sorted(keys) != sorted(known):
        raise ContractError(
            f"{path}: the policy's images are {list(known)}, the contract's are {keys}; name all "
            'cameras in [contract] cameras = [...], and in [images] NAME = "KEY" the policy\'s '
            "key of each"
        )
    return tuple(known.index(key) for key in keys)
