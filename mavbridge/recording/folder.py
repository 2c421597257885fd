"""A flight's folder: the check that it can be written, its removal, and ``meta.json``: facts about
the flight, its policy and its contract. Imports no extra.
"""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from mavbridge.core.errors import UserError
from mavbridge.core.files import as_json, from_json, write_durably
from mavbridge.core.records import FlightOutcome, RateMode
from policy.contract import Contract
from policy.data import flight_files as files
from policy.data.flight_files import META, of_camera, read_meta_document, video_of
from policy.errors import ContractError, DatasetError, require_packages

EXTRA = ("av", "pyarrow")
"""Packages of the ``record`` extra."""
FlightSource = Literal["flight", "demonstration", "dagger", "pilot"]


def require_extra(what: str) -> None:
    """Raise UserError if the extra is not installed. ``what`` is the feature that needs it."""
    require_packages(what, *EXTRA)


def prepare_folder(folder: Path, flag: str) -> None:
    """Create the folder that a flag names; raise UserError if no flight can be recorded into it."""
    require_extra(flag)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        taken = sorted(entry.name for entry in folder.iterdir())
        if not taken:
            probe = folder / META
            probe.open("xb").close()
            probe.unlink()
    except OSError as error:
        raise UserError(
            f"{flag} {folder} cannot be written ({error.strerror}); name a folder that you may "
            "write to"
        ) from error
    if taken:
        raise UserError(
            f"{flag} {folder} is not empty (it holds {taken[0]}); every flight has a folder of "
            "its own: name a new one"
        )


def remove_flight(folder: Path, cameras: Sequence[str]) -> None:
    """Delete the files of a recorded flight; other files, and the folder, stay."""
    names = (None, *cameras[1:])
    of_cameras = [
        of_camera(stem, name) for stem in (files.FRAMES, files.FEATURES) for name in names
    ]
    stems = (files.TICKS, files.SOLVES, files.PACKETS, *of_cameras)
    tables = (f"{stem}.{ending}" for stem in stems for ending in ("arrows", "parquet"))
    for name in (META, files.SETTINGS, files.TLOG, *map(video_of, names), *tables):
        with suppress(OSError):
            (folder / name).unlink(missing_ok=True)


@dataclass(frozen=True, kw_only=True)
class FlightMeta:
    """Facts about a whole flight; None: unknown, or not known yet."""

    started_at: str
    """ISO 8601, UTC."""
    start_ns: int
    """Start of the flight on the clock of all stamps."""
    source: FlightSource
    policy: str | None
    engine: str | None
    mode: RateMode
    autopilot: str | None = None
    action_hz: float
    visual_hz: float
    contract: Contract
    course_seed: int | None = None
    seed: int | None = None
    finished: bool = False
    """True if the recording was closed in order."""
    ticks: int | None = None
    frames: int | None = None
    """Number of rows in the tables of ticks and of frames; known at the end."""
    ticks_dropped: int | None = None
    frames_dropped: int | None = None
    packets_dropped: int | None = None
    """Each ``*_dropped`` counts the losses before the last row of its files, of all cameras."""
    success: bool | None = None
    """True if the flight is an example to follow: by the pilot's mark, else by course and outcome.
    False after a crash or a fault."""
    crash: str | None = None
    """How the vehicle crashed, in words."""
    gates_passed: int | None = None
    outcome: FlightOutcome | None = None
    """How the policy's flight ended; None if no policy flew, and in older flights."""
    conditions: dict[str, float] = field(default_factory=dict)
    """Randomised physical quantities, by name."""
    command: tuple[str, ...] = ()
    """Command line, one word per item, without passwords."""
    versions: dict[str, str] = field(default_factory=dict)
    """Versions of mavbridge, Python, the system and relevant packages, by name."""
    git_revision: str | None = None
    """Commit of the checkout that ran, with ``-dirty`` if files differed from it."""
    policy_files: dict[str, str] = field(default_factory=dict)
    """SHA-256 of the policy's files (weights, contract, code), by absolute path."""
    cameras: dict[str, str] = field(default_factory=dict)
    """Source of each camera, by its name in the contract."""
    plan: dict[str, float] = field(default_factory=dict)
    """Rates, periods and limits of the flight, as resolved from flags and contract."""
    parameters: dict[str, float] = field(default_factory=dict)
    """Flight-relevant parameters read from the autopilot, by name."""

    @property
    def loss(self) -> str | None:
        """Missing part of the recording, in words; None if it was closed in order."""
        if self.finished:
            return None
        if self.ticks is None:
            return "cut off: shown up to its last whole batch of rows"
        return "images and packets lost: the process that writes them died; the tables are whole"

    @property
    def keeps_neutral(self) -> bool:
        """True if neutral is due in each pass of the way out; setpoints to PX4 end before it
        does."""
        is_stick_flight = self.contract.action == "sticks"
        return is_stick_flight or (self.autopilot or "").startswith("ardupilot")

    def with_outcome(self, outcome: FlightOutcome) -> "FlightMeta":
        """Add the outcome; derive ``success`` from it if it is not set yet."""
        success = outcome.success if self.success is None else self.success
        return replace(self, outcome=outcome, success=success)


def write_meta(folder: Path, meta: FlightMeta) -> None:
    """Write or replace ``meta.json``; raise OSError if that fails."""
    write_durably(
        folder / META, as_json({"format": files.FORMAT, "version": files.VERSION} | vars(meta))
    )


def read_meta(folder: Path) -> FlightMeta:
    """Read ``meta.json``; raise DatasetError if it is missing, not ours, or damaged."""
    document = read_meta_document(folder)
    try:
        meta = from_json(FlightMeta, document)
    except (KeyError, TypeError, ValueError, ContractError) as error:
        raise DatasetError(f"{folder / META} is incomplete or damaged: {error}") from error
    for name in ("action_hz", "visual_hz"):
        if not 0 < getattr(meta, name) < math.inf:  # also of NaN
            raise DatasetError(f"{folder / META}: {name} is {getattr(meta, name)}, not above zero")
    for name in ("start_ns", "course_seed", "ticks_dropped", "frames_dropped", "packets_dropped"):
        if (getattr(meta, name) or 0) < 0:
            raise DatasetError(f"{folder / META}: {name} is {getattr(meta, name)}, below zero")
    return meta
