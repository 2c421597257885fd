"""What a benchmark of rollouts found: frozen values, and their JSON."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Literal

from mavbridge.commands.bench.results import Machine

Way = Literal["serial", "streamed"]


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One rollout in a process of its own."""

    way: Way
    """serial: decode everything at once, write everything at the end. streamed: ours."""
    device: str
    iterations: int
    ddim_steps: int
    torch_threads: int
    """Of an operation: the plain way takes every core, ours leaves one for the decoder."""
    frames: int
    """In the video."""
    frames_decoded: int
    wall_s: float
    """From the first decision to closed files."""
    start_s: float
    """Before that: files and the writer process."""
    sample_s: float
    """The loop's thread inside the world model."""
    decode_s: float
    """The loop's thread waiting for pixels, or for room in the decode queue."""
    write_s: float
    """The loop's thread waiting for the files."""
    peak_rss_mb: float
    """Of the process with the nets."""
    writer_rss_mb: float | None
    """Of the writer process; None where there is none."""
    peak_gpu_mb: float | None
    """Of torch's allocator; None on a CPU."""
    sha256: str
    """Of all frames."""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Both ways through one rollout; of each the median run."""

    serial: Trial
    streamed: Trial

    @property
    def speed_up(self) -> float:
        """Serial over ours."""
        return self.serial.wall_s / self.streamed.wall_s

    @property
    def bound(self) -> float:
        """Amdahl's: the speed-up if all but the sampling took no time."""
        return self.serial.wall_s / self.serial.sample_s

    @property
    def is_exact(self) -> bool:
        """The same frames, bit for bit."""
        return self.serial.sha256 == self.streamed.sha256


@dataclass(frozen=True, kw_only=True)
class RolloutBench:
    """One run."""

    machine: Machine
    quick: bool
    world_model: str
    frames: int
    """Of each iteration."""
    exe_steps: int
    by_iterations: tuple[Comparison, ...]
    by_steps: tuple[Comparison, ...]


def trial_from_json(text: str) -> Trial:
    """What a trial's process wrote."""
    return Trial(**json.loads(text))


def typical(trials: Sequence[Trial]) -> Trial:
    """The trial whose wall time is the median (the lower one of two)."""
    ordered = sorted(trials, key=lambda trial: trial.wall_s)
    return ordered[(len(ordered) - 1) // 2]


def to_json(result: RolloutBench) -> str:
    """Keys in the order of the dataclasses, with what follows from them; null = not measured."""
    document = asdict(result)
    for key in ("by_iterations", "by_steps"):
        for comparison, shown in zip(getattr(result, key), document[key], strict=True):
            shown["speed_up"] = round(comparison.speed_up, 4)
            shown["bound"] = round(comparison.bound, 4)
            shown["is_exact"] = comparison.is_exact
    return json.dumps(document, indent=2, allow_nan=False) + "\n"
