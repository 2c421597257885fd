"""``mavbridge train``: flight folders in, a checkpoint out, and what a person sees meanwhile."""

import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import TracebackType

import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.text import Text

from mavbridge.config.train import TrainConfig
from mavbridge.core.clock import NS_PER_MS, NS_PER_S, MonotonicClock
from mavbridge.core.errors import UserError
from mavbridge.core.stopping import INTERRUPTED, stop_on_signals
from policy.contract import Contract
from policy.data.episodes import Episode, Nanoseconds, common_frame
from policy.loading import builtin_config
from policy.training.plan import Budget, Check, TrainSettings, WorldTrainSettings
from policy.training.report import Progress as TrainProgress
from policy.training.report import Report, TrainResult
from policy.training.run import train
from policy.training.state import TrainingStoppedError
from policy.training.world_model.run import train_world_model
from policy.world_model.config import WorldModelConfig

MINUTES = 45.0
IMAGE_SIZE = 224
WORLD_MODEL = "world-model"
"""In place of a policy: what ``mavbridge imagine`` imagines with."""


def train_policy(flights: Sequence[Path], config: TrainConfig, out: Path) -> int:
    """Train as the config says; 0 when the checkpoint is written, 130 if interrupted.

    Args:
        flights: flight folders, folders of them, or LeRobot datasets.
        config: the settings.
        out: the checkpoint.

    Raises:
        UserError: pyarrow or PyAV is missing, or a flag cannot be used.
        PolicyError: flights, weights or a run that cannot be used.
    """
    _require_device(config.device)
    if config.policy == WORLD_MODEL:
        _refuse_what_no_world_model_takes(config)
    episodes = _read_episodes(flights, config.camera_key)
    try:
        with stop_on_signals() as stop, _Display() as display:
            result = _train(episodes, config, out, display.show, stop.is_set)
    except TrainingStoppedError as stopped:
        Console(stderr=True, highlight=False).print(Text(str(stopped), style="yellow"))
        return INTERRUPTED
    _print_result(result)
    return 0


def _train(
    episodes: list[Episode],
    config: TrainConfig,
    out: Path,
    report: Report,
    should_stop: Callable[[], bool],
) -> TrainResult:
    clock = MonotonicClock()

    def now_s() -> float:
        return clock.now_ns() / NS_PER_S

    if config.policy == WORLD_MODEL:
        return train_world_model(
            episodes,
            _world_model_settings(config, out, episodes),
            now_s=now_s,
            report=report,
            should_stop=should_stop,
        )
    return train(
        episodes,
        _settings(config, out, episodes),
        now_s=now_s,
        report=report,
        should_stop=should_stop,
        check=_check(config),
    )


def _read_episodes(paths: Sequence[Path], camera_key: str | None) -> list[Episode]:
    """A folder with meta/info.json is a LeRobot dataset, every other one flights of ours."""
    try:
        from policy.data.flight_folders import find_flights, is_exemplary, read_flight
        from policy.data.lerobot import is_lerobot, read_dataset
    except ImportError as error:
        raise UserError(
            f"reading flights needs pyarrow and PyAV ({error}): install mavbridge[record]"
        ) from error
    datasets = [path for path in paths if is_lerobot(path)]
    if camera_key is not None and not datasets:
        raise UserError("--camera-key is for LeRobot datasets; flights have one camera")
    flights = [path for path in paths if path not in datasets]
    folders = find_flights(flights) if flights else []
    episodes = [read_flight(folder) for folder in folders if is_exemplary(folder)]
    return episodes + [e for path in datasets for e in read_dataset(path, camera_key)]


def _settings(config: TrainConfig, out: Path, episodes: list[Episode]) -> TrainSettings:
    network = builtin_config(config.policy, image_size=config.image_size or IMAGE_SIZE)
    contract = replace(
        network.contract,
        state_frame=common_frame(episodes),
        since_exposure=config.since_exposure,
    )
    return TrainSettings(
        policy=replace(network, contract=contract),
        out=out,
        budget=_budget(config),
        batch_size=config.batch_size or TrainSettings.batch_size,
        gate_weight=config.gate_weight,
        mirror=config.mirror,
        seed=config.seed,
        device=config.device,
        resume=config.resume,
        validation_fraction=config.validation_fraction,
        ages_ns=None if config.ages is None else _ages(config.ages),
        start_from=config.start_from,
        freeze_encoder=config.freeze_encoder,
        pack=config.pack,
        backbone_weights=config.backbone_weights,
    )


def _check(config: TrainConfig) -> Check | None:
    """Flights in closed loop, if there are to be any."""
    if config.check_flights == 0:
        return None
    try:
        from mavbridge.commands.train.check_flights import share_of_gates
    except ImportError as error:
        raise UserError(
            f"--check-flights needs the simulator ({error}): install mavbridge[sitl]"
        ) from error
    return lambda checkpoint: share_of_gates(checkpoint, config.policy, config.check_flights)


def _world_model_settings(
    config: TrainConfig, out: Path, episodes: list[Episode]
) -> WorldTrainSettings:
    contract = Contract(state_frame=common_frame(episodes))
    size = WorldModelConfig.image_size if config.image_size is None else config.image_size
    return WorldTrainSettings(
        model=WorldModelConfig(image_size=size, contract=contract),
        out=out,
        budget=_budget(config),
        batch_size=config.batch_size or WorldTrainSettings.batch_size,
        mirror=config.mirror,
        seed=config.seed,
        device=config.device,
        resume=config.resume,
        validation_fraction=config.validation_fraction,
        autoencoder_of=config.start_from,
    )


def _refuse_what_no_world_model_takes(config: TrainConfig) -> None:
    for flag, value in (
        ("--ages", config.ages),
        ("--backbone-weights", config.backbone_weights),
        ("--check-flights", config.check_flights),
        ("--pack", config.pack),
    ):
        if value:
            raise UserError(f"{flag} is for policies: leave it out for a world model")
    if config.freeze_encoder != (config.start_from is not None):
        raise UserError(
            "a world model takes --start-from and --freeze-encoder together: the autoencoder of "
            "the one is kept as it is, and the dynamics learns anew"
        )


def _budget(config: TrainConfig) -> Budget:
    if config.steps:
        return Budget(steps=config.steps)
    return Budget(seconds=60.0 * (MINUTES if config.minutes is None else config.minutes))


def _ages(spec: str) -> Nanoseconds:
    """``--ages``: a flight folder, or a range in ms whose ages are all as likely."""
    from policy.data.flight_folders import read_ages

    low, colon, high = spec.partition(":")
    if Path(spec).is_dir() or not colon:
        return read_ages(Path(spec))
    try:
        low_ms, high_ms = float(low), float(high)
    except ValueError:
        low_ms, high_ms = np.nan, np.nan
    if not 0 < low_ms <= high_ms <= 1000:
        raise UserError(
            f"--ages {spec} is neither a flight folder nor LOW:HIGH with 0 < LOW <= HIGH <= 1000 ms"
        )
    return np.linspace(low_ms * NS_PER_MS, high_ms * NS_PER_MS, 256).astype(np.int64)


def _require_device(device: str) -> None:
    available = ["cpu", *(f"cuda:{index}" for index in range(torch.cuda.device_count()))]
    if (device if device != "cuda" else "cuda:0") not in available:
        raise UserError(f"--device {device} is not available; this machine has {available}")


class _Display:
    """A bar where there is a terminal, a line now and then where there is none."""

    def __init__(self) -> None:
        self._console = Console(file=sys.stderr, highlight=False)
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TaskProgressColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[losses]}"),
            console=self._console,
        )
        self._task = self._bar.add_task("starting", total=1.0, losses="")

    def __enter__(self) -> "_Display":
        self._bar.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._bar.stop()

    def show(self, progress: TrainProgress) -> None:
        """Everything that the run reports."""
        if progress.note is not None:
            self._bar.print(f"note: {progress.note}")
            return
        self._bar.update(self._task, description=progress.stage, completed=progress.fraction)
        if progress.losses is not None:
            parts = (f"{name} {value:.3f}" for name, value in progress.losses.items())
            losses = f"step {progress.step}  {'  '.join(parts).replace('_', ' ')}"
            self._bar.update(self._task, losses=losses)
        if progress.validation is not None:
            self._bar.print(
                f"{progress.fraction:4.0%} {progress.stage}, step {progress.step}: "
                f"{progress.validation.describe()}"
            )


def _print_result(result: TrainResult) -> None:
    console = Console(highlight=False)
    console.print(f"{result.checkpoint}: {result.steps} steps", soft_wrap=True)
    if result.validation is not None:
        console.print(result.validation.describe(), soft_wrap=True)
    if result.score is not None:
        console.print(f"closed-loop score {result.score:.3f}")
