"""First drafts of contract files: what was read, what was guessed, and what only the user knows.

A draft is TOML for ``interface.read_interface``, in which every entry has a comment that says where
its value comes from. An entry that nobody but the user can answer holds ``interface.UNANSWERED``.
"""

import json
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from policy.adapters.interface import ACTION_FIELDS, UNANSWERED
from policy.adapters.state import DERIVED_NAMES
from policy.contract import STATE_NAMES

Table = Literal["contract", "state", "action", "images", "task"]
Origin = Literal["read", "guessed", "to answer", "optional"]
Value = str | float | int | bool | Sequence[str] | Sequence[float]

_WIDTH = 96
_SPELLINGS: Mapping[str, Sequence[str]] = {
    "vx_mps": ("vx", "vel_x", "velocity_x"),
    "vy_mps": ("vy", "vel_y", "velocity_y"),
    "vz_mps": ("vz", "vel_z", "velocity_z"),
    "qw": ("quat_w", "q_w", "orientation_w"),
    "qx": ("quat_x", "q_x", "orientation_x"),
    "qy": ("quat_y", "q_y", "orientation_y"),
    "qz": ("quat_z", "q_z", "orientation_z"),
    "wx_radps": ("wx", "rollspeed", "roll_rate", "angular_velocity_x", "gyro_x"),
    "wy_radps": ("wy", "pitchspeed", "pitch_rate", "angular_velocity_y", "gyro_y"),
    "wz_radps": ("wz", "yawspeed", "yaw_rate", "angular_velocity_z", "gyro_z"),
    "ax_mps2": ("ax", "acc_x", "accel_x", "linear_acceleration_x"),
    "ay_mps2": ("ay", "acc_y", "accel_y", "linear_acceleration_y"),
    "az_mps2": ("az", "acc_z", "accel_z", "linear_acceleration_z"),
    "roll_rad": ("roll",),
    "pitch_rad": ("pitch",),
    "yaw_rad": ("yaw", "heading"),
}
"""Usual names of others for numbers of the state; their units are a guess."""


@dataclass(frozen=True, kw_only=True)
class Entry:
    """A line of a draft."""

    table: Table
    name: str
    value: Value
    origin: Origin
    """Optional entries are written as comments."""
    why: str
    """Where the value comes from, or the question to the user."""


def draft_text(title: str, entries: Sequence[Entry]) -> str:
    """A contract file that begins with ``title``; a comment above each entry says its origin."""
    lines = _comment(title)
    for table in ("contract", "state", "action", "images", "task"):
        inside = [entry for entry in entries if entry.table == table]
        if inside:
            lines += ["", f"[{table}]"]
        said: list[str] = []
        for entry in inside:
            comment = _comment(f"{entry.origin.upper()}: {entry.why}")
            lines += comment if comment != said else []
            said = comment
            # JSON's texts, numbers and lists are TOML's as well.
            line = f"{entry.name} = {json.dumps(entry.value)}"
            lines.append(f"# {line}" if entry.origin == "optional" else line)
    return "\n".join(lines) + "\n"


def state_entries(names: Sequence[str] | None, dim: int, where: str) -> list[Entry]:
    """The state's names: known, guessed by their spelling, or to be answered."""
    if dim == 0:
        return []
    known = (*STATE_NAMES, *DERIVED_NAMES)
    guesses = {other: name for name, others in _SPELLINGS.items() for other in others}
    given = list(names) if names is not None and len(names) == dim else [""] * dim
    found = [name if name in known else guesses.get(name.lower(), UNANSWERED) for name in given]
    question = f"names of its {dim} numbers in their order, of {', '.join(known)}"
    if UNANSWERED in found:
        called = f"; {where} calls them {', '.join(given)}" if any(given) else ""
        entry = Entry(
            table="state", name="names", value=found, origin="to answer", why=f"{question}{called}"
        )
    elif found == given:
        entry = Entry(table="state", name="names", value=found, origin="read", why=where)
    else:
        why = f"{where} calls them {', '.join(given)}; are these its units, and its axes?"
        entry = Entry(table="state", name="names", value=found, origin="guessed", why=why)
    scale = Entry(
        table="state",
        name="scale",
        value=[1.0] * dim,
        origin="optional",
        why="factor from the units above to the policy's, e.g. 57.29578 for degrees",
    )
    return [entry, scale]


def action_entries(names: Sequence[str] | None, where: str) -> list[Entry]:
    """The kind of action, and its names: known, or to be answered."""
    kinds = [
        kind for kind, fields in ACTION_FIELDS.items() if sorted(fields) == sorted(names or ())
    ]
    choices = "; ".join(f"{kind}: {', '.join(fields)}" for kind, fields in ACTION_FIELDS.items())
    called = f"; {where} calls them {', '.join(names)}" if names else ""
    scaling = [
        Entry(
            table="action",
            name=name,
            value=value,
            origin="optional",
            why=f"from the policy's units to those of the names: {rule}",
        )
        for name, value, rule in (
            ("scale", [1.0] * 4, "a factor, e.g. -1.0 for another sign"),
            ("offset", [0.0] * 4, "added after the factor"),
        )
    ]
    if kinds and names:
        return [
            Entry(table="contract", name="action", value=kinds[0], origin="read", why=where),
            Entry(table="action", name="names", value=list(names), origin="read", why=where),
        ]
    return [
        Entry(
            table="contract",
            name="action",
            value=UNANSWERED,
            origin="to answer",
            why=f"what its four actions are. {choices}{called}",
        ),
        Entry(
            table="action",
            name="names",
            value=[UNANSWERED] * 4,
            origin="to answer",
            why="the four names of that kind, in the policy's order",
        ),
        *scaling,
    ]


def rate_entry(rate_hz: float | None, where: str) -> Entry:
    """The time between actions."""
    if rate_hz is not None and rate_hz >= 1.0:
        dt_s = round(1.0 / rate_hz, 6)
        why = f"{where}: {rate_hz:g} a second"
        return Entry(table="contract", name="chunk_dt_s", value=dt_s, origin="read", why=why)
    why = "seconds from one action of a chunk to the next: 1 / frames a second of its dataset"
    return Entry(table="contract", name="chunk_dt_s", value=UNANSWERED, origin="to answer", why=why)


def frame_entry(state_frame: str | None, origin: Origin, why: str) -> Entry:
    """The axes of state and action."""
    if state_frame is None:
        origin = "to answer"
        why = "axes of its state and action: ned_frd (z down, as MAVLink) or enu_flu (z up, as ROS)"
    return Entry(
        table="contract",
        name="state_frame",
        value=state_frame or UNANSWERED,
        origin=origin,
        why=why,
    )


def camera_entries(keys: Sequence[str], where: str) -> list[Entry]:
    """Names of the cameras here, and the policy's names of them."""
    if len(keys) < 2:
        cameras = ["front"] * len(keys)
    else:
        cameras = [key.rpartition(".")[2] for key in keys]
        if len(set(cameras)) < len(keys) or not all(name.isidentifier() for name in cameras):
            cameras = [f"camera_{number}" for number in range(len(keys))]
    names = Entry(
        table="contract",
        name="cameras",
        value=cameras,
        origin="guessed",
        why="names of the vehicle's cameras; with several, those that --camera gives them",
    )
    images = [
        Entry(table="images", name=camera, value=key, origin="read", why=where)
        for camera, key in zip(cameras, keys, strict=True)
    ]
    return [names, *images] if images else []


def _comment(text: str) -> list[str]:
    return textwrap.wrap(text, _WIDTH, initial_indent="# ", subsequent_indent="# ")
