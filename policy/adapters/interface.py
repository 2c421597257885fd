"""Contract file: the user's TOML with the facts that a foreign policy's files do not contain.

Its tables are [contract], with fields of ``policy.contract.Contract``; [state] and [action], with
key, names and scale of the policy's own vectors; [images], with the policy's name of each camera;
and [task], with a prompt (docs/policy_lerobot.md). Entries are optional unless the kind of policy
needs them. State names are those of the contract and ``DERIVED_NAMES``. In a draft
(``adapters.drafts``), "?" marks what only the user knows; a contract with a "?" does not fly.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np

from policy.contract import ACTION_DIM, ACTION_NAMES, QUATERNION, STATE_NAMES, Contract
from policy.errors import ContractError, PolicyError
from policy.files import UNANSWERED, read_toml
from policy.motion.rotation import matrix_columns
from policy.preprocess import egocentric_columns

ACTION_FIELDS: dict[str, tuple[str, ...]] = {
    "sticks": ACTION_NAMES,
    "rates": ("thrust", "roll_rate_radps", "pitch_rate_radps", "yaw_rate_radps"),
    "attitude": ("thrust", "roll_rad", "pitch_rad", "yaw_rate_radps"),
    "velocity": ("vx_mps", "vy_mps", "vz_mps", "yaw_rate_radps"),
}
"""Names of an action's four numbers by action kind, in the contract's order."""
EGOCENTRIC_NAMES = (
    *("vx_body_mps", "vy_body_mps", "vz_body_mps"),
    *("vertical_x", "vertical_y", "vertical_z"),
)
"""Velocity and the world's third axis in body axes: independent of the heading, so a network that
takes them has no rotations to learn."""
EULER_NAMES = ("roll_rad", "pitch_rad", "yaw_rad")
"""Angles of the attitude, turned in the order yaw, pitch, roll; signs by the contract's frame."""
DERIVED_NAMES = (*EGOCENTRIC_NAMES, *EULER_NAMES)
BODY_STATE_NAMES = (*EGOCENTRIC_NAMES, *STATE_NAMES[QUATERNION.stop :])
"""State without a heading: velocity, vertical axis, rates and specific force in body axes."""
ArrayOrTensor = TypeVar("ArrayOrTensor")


def state_values(
    columns: Sequence[Any],
    names: Sequence[str],
    wanted: Sequence[str],
    arctan2: Callable[[Any, Any], Any] = np.arctan2,
) -> list[Any]:
    """Return the ``wanted`` numbers, computed from state ``columns`` with the names ``names``.

    ``names`` begin with ``STATE_NAMES``. Columns are floats or arrays of any library, torch
    included; ``arctan2`` comes from the same library.
    """
    known = dict(zip(names, columns, strict=True))
    base = [known[name] for name in STATE_NAMES]
    if set(wanted) & set(EGOCENTRIC_NAMES):
        known |= dict(zip(EGOCENTRIC_NAMES, egocentric_columns(base), strict=False))
    if set(wanted) & set(EULER_NAMES):
        x_axis, y_axis, z_axis = matrix_columns(*base[QUATERNION])
        level = (x_axis[0] * x_axis[0] + x_axis[1] * x_axis[1]) ** 0.5
        known["roll_rad"] = arctan2(y_axis[2], z_axis[2])
        known["pitch_rad"] = arctan2(-x_axis[2], level)
        known["yaw_rad"] = arctan2(x_axis[1], x_axis[0])
    return [known[name] for name in wanted]


@dataclass(frozen=True, kw_only=True)
class Interface:
    """Names, order and units of a policy's inputs and outputs."""

    contract: Contract
    state_names: tuple[str, ...] = ()
    """State in ``contract.state_names`` and ``DERIVED_NAMES``; empty: the contract's state."""
    state_scale: tuple[float, ...] = ()
    """Factor from the contract's unit to the policy's for each number of the state; empty: ones."""
    action_names: tuple[str, ...] = ()
    """Action in ``ACTION_FIELDS``; empty: the contract's action."""
    action_scale: tuple[float, ...] = ()
    """Factor of each action, in the policy's order; empty: ones."""
    action_offset: tuple[float, ...] = ()
    """Offset of each action, added after the factor; empty: zeros."""
    state_key: str = "observation.state"
    action_key: str = "action"
    image_keys: tuple[str, ...] = ()
    """The policy's name of each camera, in the contract's order; empty: observation.images.NAME."""
    prompt: str = ""
    """Task in words, for policies that take a prompt."""

    def __post_init__(self) -> None:
        known = (*self.contract.state_names, *DERIVED_NAMES)
        if unknown := [name for name in self.state_names if name not in known]:
            raise ContractError(f"[state] names {unknown} are unknown; known are {list(known)}")
        wanted = ACTION_FIELDS[self.contract.action]
        if self.action_names and sorted(self.action_names) != sorted(wanted):
            raise ContractError(
                f"[action] names must be {list(wanted)} in some order for action "
                f"{self.contract.action!r}, got {list(self.action_names)}"
            )
        if len(self.state_scale) not in (0, self.state_dim):
            raise ContractError(
                f"[state] scale must be {self.state_dim} numbers, one a name, got "
                f"{list(self.state_scale)}"
            )
        for name, values in (("scale", self.action_scale), ("offset", self.action_offset)):
            if values and len(values) != ACTION_DIM:
                raise ContractError(f"[action] {name} must be {ACTION_DIM} numbers, got {values}")
        if 0 in self.action_scale:
            raise ContractError(f"[action] scale must not be 0, got {self.action_scale}")

    @property
    def state_dim(self) -> int:
        """Width of the policy's state."""
        return len(self.state_names or self.contract.state_names)

    def to_state(self, state: ArrayOrTensor) -> ArrayOrTensor:
        """Convert the contract's state [..., S] to the policy's [..., state_dim], float32.

        Input and output are both numpy arrays or both torch tensors; torch can trace the
        operations.
        """
        names = self.contract.state_names
        wanted = self.state_names or names
        values: Any = state
        library, options = _library(state)
        if not set(wanted) <= set(names):
            columns = [values[..., column] for column in range(len(names))]
            derived = state_values(columns, names, wanted, library.arctan2)
            values = library.stack(derived, -1)
        elif wanted != names:
            values = values[..., [names.index(name) for name in wanted]]
        if self.state_scale:
            values = values * library.asarray(self.state_scale, **options)
        return cast(ArrayOrTensor, values)

    @property
    def action_columns(self) -> list[int]:
        """Return, for each number of the contract's action, its column in the policy's action."""
        wanted = ACTION_FIELDS[self.contract.action]
        return [(self.action_names or wanted).index(name) for name in wanted]

    @property
    def camera_keys(self) -> tuple[str, ...]:
        """The policy's name of each camera, in the contract's order."""
        return self.image_keys or tuple(f"observation.images.{n}" for n in self.contract.cameras)

    def to_actions(self, actions: ArrayOrTensor) -> ArrayOrTensor:
        """Convert the policy's actions [..., 4] to the contract's [..., 4], arrays or tensors."""
        values: Any = actions
        if tuple(values.shape[-1:]) != (ACTION_DIM,):
            raise PolicyError(
                f"its chunk is {list(values.shape)}, and its last axis must be the {ACTION_DIM} "
                "numbers of an action"
            )
        scale, offset = self._action_units(actions)
        return cast(ArrayOrTensor, _columns(values * scale + offset, self.action_columns))

    def from_actions(self, actions: ArrayOrTensor) -> ArrayOrTensor:
        """Convert the contract's actions [..., 4] to the policy's: the inverse of
        ``to_actions``."""
        columns = self.action_columns
        scale, offset = self._action_units(actions)
        theirs = _columns(actions, [columns.index(column) for column in range(ACTION_DIM)])
        return cast(ArrayOrTensor, (theirs - offset) / scale)

    def _action_units(self, actions: object) -> tuple[Any, Any]:
        """Return factor and offset of each action, in the library of ``actions``."""
        library, options = _library(actions)
        scale = library.asarray(self.action_scale or (1.0,) * ACTION_DIM, **options)
        return scale, library.asarray(self.action_offset or (0.0,) * ACTION_DIM, **options)


def read_interface(path: Path, derived: Mapping[str, object] | None = None) -> Interface:
    """Read a contract file.

    ``derived`` are contract fields that the policy's own files set. The contract file may repeat
    them but not contradict them.
    """
    data = read_tables(path)
    try:
        return _interface(data, derived or {})
    except (ContractError, TypeError, ValueError) as error:
        raise ContractError(f"--contract {path}: {error}") from error


def read_tables(path: Path) -> dict[str, Any]:
    """Read a contract file's tables; their values are checked only for unanswered questions."""
    try:
        data: dict[str, Any] = read_toml(path)
    except OSError as error:
        raise ContractError(f"--contract {path}: {error.strerror}") from error
    except ValueError as error:
        raise ContractError(f"--contract {path} is not TOML: {error}") from error
    if not data:
        raise ContractError(f"--contract {path} says nothing: draft it by mavbridge contract")
    if loose := [name for name, entries in data.items() if not isinstance(entries, dict)]:
        raise ContractError(f"--contract {path}: {loose} must stand in a table, as in [contract]")
    if unanswered := [
        f"[{table}] {name}"
        for table, entries in data.items()
        for name, value in entries.items()
        if is_unanswered(value)
    ]:
        raise ContractError(
            f"--contract {path}: this is a draft, in which {len(unanswered)} answers are missing: "
            f"{', '.join(unanswered)}. Replace each {UNANSWERED!r} there, by what the comment asks"
        )
    return data


def _interface(data: dict[str, Any], derived: Mapping[str, object]) -> Interface:
    tables = {name: dict(data.pop(name, {})) for name in ("contract", "state", "action", "images")}
    task = dict(data.pop("task", {}))
    said, known = (
        {name: tuple(value) if isinstance(value, list) else value for name, value in each.items()}
        for each in (tables["contract"], derived)
    )
    for name, value in known.items():
        if said.setdefault(name, value) != value:
            raise ContractError(
                f"[contract] {name} = {said[name]!r} contradicts the policy's own files, which say "
                f"{value!r}: leave it out"
            )
    contract = Contract.from_fields(said)
    state, action, images = tables["state"], tables["action"], tables["images"]
    if images and sorted(images) != sorted(contract.cameras):
        raise ContractError(
            f"[images] names {sorted(images)}, the contract's cameras are {list(contract.cameras)}"
        )
    interface = Interface(
        contract=contract,
        state_names=tuple(state.pop("names", ())),
        state_scale=_numbers("[state] scale", state.pop("scale", [])),
        state_key=_text("[state] key", state.pop("key", Interface.state_key)),
        action_names=tuple(action.pop("names", ())),
        action_key=_text("[action] key", action.pop("key", Interface.action_key)),
        action_scale=_numbers("[action] scale", action.pop("scale", [])),
        action_offset=_numbers("[action] offset", action.pop("offset", [])),
        image_keys=tuple(_text(f"[images] {n}", images[n]) for n in contract.cameras if images),
        prompt=_text("[task] prompt", task.pop("prompt", "")),
    )
    if rest := sorted((*data, *state, *action, *task)):
        raise ContractError(f"unknown entries {rest}")
    return interface


def _numbers(name: str, values: object) -> tuple[float, ...]:
    """Return a list of numbers that float32 holds, zero among them."""
    numbers: list[Any] = values if isinstance(values, list) else [None]
    if not all(type(n) in (int, float) and (n == 0 or 1e-30 < abs(n) < 1e30) for n in numbers):
        raise ContractError(f"{name} must be a list of numbers, got {values!r}")
    return tuple(map(float, numbers))


def _text(name: str, value: object) -> str:
    if not isinstance(value, str):
        raise ContractError(f"{name} must be a text, got {value!r}")
    return value


def is_unanswered(value: object) -> bool:
    """True if an entry is ``UNANSWERED``, or a list that contains it."""
    return UNANSWERED in (value if isinstance(value, list) else [value])


def _columns(values: Any, columns: list[int]) -> Any:
    """Reorder the columns of the last axis; an array's result is contiguous."""
    ordered = values[..., columns]
    return np.ascontiguousarray(ordered) if isinstance(ordered, np.ndarray) else ordered


def _library(state: object) -> tuple[Any, dict[str, Any]]:
    """Return the library of an array or tensor, and its function that makes constants."""
    if isinstance(state, np.ndarray):
        return np, {"dtype": np.float32}
    import torch

    if not isinstance(state, torch.Tensor):
        raise TypeError(f"neither an array nor a tensor: {type(state)}")
    return torch, {"dtype": torch.float32, "device": state.device}
