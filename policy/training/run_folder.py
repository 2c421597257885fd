"""A training run on disk: its state, to resume it after a kill, and its log."""

import hashlib
import json
import pickle
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from policy.data.flight_data import FlightData
from policy.data.frames import disk_error
from policy.errors import PolicyError
from policy.training.settings import RunSettings

_STATE, _LOG = "state.pt", "log.jsonl"


class TrainingError(PolicyError):
    """A run that cannot start, be resumed or be kept; the message says what to do."""


class TrainingStoppedError(PolicyError):
    """The run was asked to stop; the message says how to resume it."""


@dataclass(kw_only=True)
class Position:
    """Where a run is; saved with its weights."""

    step: int = 0
    """Optimiser steps done."""
    stage: int = 0
    """Index of the current stage."""
    phase_step: int = 0
    """``step`` at which the phase began: the encoder learns, or it is frozen."""
    phase_start: float = 0.0
    """Fraction of the budget used up to then."""
    spent_s: float = 0.0
    """Time used up to the last save."""
    validations: int = 0
    best: float | None = None
    """Score of the exported weights, more is better."""
    kept: dict[str, Any] | None = None
    """Validation of the exported weights."""


class RunFolder:
    """Files that a run keeps until it is over."""

    def __init__(self, path: Path, identity: str) -> None:
        self.path = path
        self._identity = identity
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise TrainingError(f"{path}: {error.strerror}") from error

    @property
    def has_state(self) -> bool:
        """Whether there is a state to resume from."""
        return (self.path / _STATE).is_file()

    def save(self, position: Position, tensors: Mapping[str, Any]) -> None:
        """Write the state in one piece or not at all.

        Raises:
            TrainingError: no room.
        """
        target, partial = self.path / _STATE, self.path / (_STATE + ".partial")
        contents = {"identity": self._identity, "position": asdict(position), **tensors}
        try:
            torch.save(contents, partial)
            partial.replace(target)
        except (OSError, RuntimeError) as error:  # torch's writer raises RuntimeError
            partial.unlink(missing_ok=True)
            reason = disk_error(target, error) if isinstance(error, OSError) else error
            raise TrainingError(f"the training cannot be kept: {reason}") from error

    def load(self) -> tuple[Position, dict[str, Any]]:
        """The state that was saved last.

        Raises:
            TrainingError: there is none, it is damaged, or of another run.
        """
        path = self.path / _STATE
        if not path.is_file():
            raise TrainingError(f"{self.path} holds no run to resume: leave out --resume")
        try:
            contents = torch.load(path, map_location="cpu", weights_only=True)
            identity, position = contents.pop("identity"), Position(**contents.pop("position"))
        except (OSError, RuntimeError, KeyError, TypeError, EOFError, pickle.PickleError) as error:
            raise TrainingError(
                f"{path} is damaged ({error}): remove {self.path} and start again"
            ) from error
        if identity != self._identity:
            raise TrainingError(
                f"{path} is of a run with other flights or settings: give the same ones, or remove "
                f"{self.path} to start again"
            )
        self._cut_log(position.step)
        return position, contents

    def log(self, record: Mapping[str, object]) -> None:
        """One line of JSON."""
        try:
            with (self.path / _LOG).open("a") as file:
                file.write(json.dumps(record) + "\n")
        except OSError as error:
            raise TrainingError(str(disk_error(self.path / _LOG, error))) from error

    @property
    def frames(self) -> Path:
        """Folder of the decoded images."""
        return self.path / "frames"

    @property
    def features(self) -> Path:
        """File of the stored features."""
        return self.path / "features.f16"

    def clear(self) -> None:
        """Remove all but the log."""
        shutil.rmtree(self.frames, ignore_errors=True)
        self.features.unlink(missing_ok=True)
        (self.path / _STATE).unlink(missing_ok=True)

    def start_log(self) -> None:
        """Remove the log of an earlier run."""
        (self.path / _LOG).unlink(missing_ok=True)

    def _cut_log(self, step: int) -> None:
        """Remove the lines after a step: those steps are about to be repeated."""
        path = self.path / _LOG
        if path.is_file():
            lines = path.read_text().splitlines(keepends=True)
            kept = [line for line in lines if _step_of(line) <= step]
            path.write_text("".join(kept))


def _step_of(line: str) -> float:
    try:
        record: object = json.loads(line)
    except ValueError:
        return float("inf")  # the kill cut it short
    step = record.get("step") if isinstance(record, dict) else None
    return step if isinstance(step, int) else float("inf")


def identity_of(settings: RunSettings, network: object, flights: Sequence[FlightData]) -> str:
    """Hash of everything that must be the same when a run is resumed."""
    free = ("resume", "device", "out", "check_every", "check_flights")
    fixed = {name: str(value) for name, value in vars(settings).items() if name not in free}
    videos = [(flight.fingerprint, len(flight.tick_ns)) for flight in flights]
    text = json.dumps([fixed, str(network), videos], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()
