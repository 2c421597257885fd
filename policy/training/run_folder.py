"""Training run on disk: its state, for resuming after an interruption, and its log."""

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
from policy.files import whole_file
from policy.training.settings import RunSettings


class TrainingError(PolicyError):
    """Run that cannot start, be resumed or be saved; the message names the next step."""


class TrainingStoppedError(PolicyError):
    """The run was asked to stop; the message says how to resume it."""


@dataclass(kw_only=True)
class TrainingPosition:
    """Position of a run; saved with its weights."""

    step: int = 0
    """Completed optimiser steps."""
    stage: int = 0
    """Index of the current stage."""
    phase_step: int = 0
    """``step`` at the start of the phase: the encoder learns, or it is frozen."""
    phase_start: float = 0.0
    """Fraction of the budget used at the start of the phase."""
    spent_s: float = 0.0
    """Time used up to the last save."""
    validations: int = 0
    best: float | None = None
    """Score of the exported weights, higher is better."""
    kept: dict[str, Any] | None = None
    """Validation of the exported weights."""


class RunFolder:
    """Files that a run keeps until it is over."""

    def __init__(self, path: Path, identity: str) -> None:
        self.path, self._identity = path, identity
        self.frames, self.features = path / "frames", path / "features.f16"
        """Folder of the decoded images, file of the stored features."""
        self._state, self._log = path / "state.pt", path / "log.jsonl"
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise TrainingError(f"{path}: {error.strerror}") from error

    @property
    def has_state(self) -> bool:
        """True if there is a state to resume from."""
        return self._state.is_file()

    def save(self, position: TrainingPosition, tensors: Mapping[str, Any]) -> None:
        """Write the state atomically, or raise a ``TrainingError``."""
        contents = {"identity": self._identity, "position": asdict(position), **tensors}
        try:
            with whole_file(self._state) as draft:
                torch.save(contents, draft)
        except (OSError, RuntimeError) as error:  # torch's writer raises RuntimeError
            reason = disk_error(self._state, error) if isinstance(error, OSError) else error
            raise TrainingError(f"the training cannot be kept: {reason}") from error

    def load(self) -> tuple[TrainingPosition, dict[str, Any]]:
        """Return the state that was saved last."""
        path = self._state
        if not path.is_file():
            raise TrainingError(f"{self.path} holds no run to resume: leave out --resume")
        try:
            contents = torch.load(path, map_location="cpu", weights_only=True)
            identity, position = (
                contents.pop("identity"),
                TrainingPosition(**contents.pop("position")),
            )
        except (OSError, RuntimeError, KeyError, TypeError, EOFError, pickle.PickleError) as error:
            raise TrainingError(
                f"{path} is damaged ({error}): remove {self.path} and start again"
            ) from error
        if identity != self._identity:
            raise TrainingError(
                f"{path} is of a run with other flights or settings: give the same ones, or remove "
                f"{self.path} to start again"
            )
        if self._log.is_file():  # the steps after the saved one are about to be repeated
            lines = self._log.read_text().splitlines(keepends=True)
            kept = [line for line in lines if _step_of(line) <= position.step]
            self._log.write_text("".join(kept))
        return position, contents

    def log(self, record: Mapping[str, object]) -> None:
        """Append one line of JSON to the log."""
        try:
            with self._log.open("a") as file:
                file.write(json.dumps(record) + "\n")
        except OSError as error:
            raise TrainingError(str(disk_error(self._log, error))) from error

    def clear(self) -> None:
        """Remove all files except the log."""
        shutil.rmtree(self.frames, ignore_errors=True)
        self.features.unlink(missing_ok=True)
        self._state.unlink(missing_ok=True)

    def start_log(self) -> None:
        """Remove the log of an earlier run."""
        self._log.unlink(missing_ok=True)


def _step_of(line: str) -> float:
    try:
        return float(json.loads(line)["step"])
    except (ValueError, TypeError, KeyError):
        return float("inf")  # cut short by a kill


def identity_of(settings: RunSettings, network: object, flights: Sequence[FlightData]) -> str:
    """Return a hash of everything that must be equal when a run is resumed."""
    free = ("resume", "device", "out", "check_every", "check_flights")
    fixed = {name: str(value) for name, value in vars(settings).items() if name not in free}
    videos = [(flight.fingerprint, len(flight.tick_ns)) for flight in flights]
    text = json.dumps([fixed, str(network), videos], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()
