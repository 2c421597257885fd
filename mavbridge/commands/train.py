"""``mavbridge train`` and ``train-world-model``: flights in, a checkpoint out."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from rich.progress import Progress, TaskID

from mavbridge.commands.output import print_warnings, progress_bar, text_console
from mavbridge.core.clock import NS_PER_S, MonotonicClock
from mavbridge.core.errors import UserError
from mavbridge.core.stopping import INTERRUPTED, stop_on_signals
from policy.contract import STICK_TERMS, Contract
from policy.data.flight_data import FlightData, common_contract
from policy.data.flight_folders import find_flights, leave_out_failed, read_flights
from policy.data.lerobot import read_dataset
from policy.data.lerobot_format import is_lerobot
from policy.engines.runner import require_device
from policy.errors import DatasetError
from policy.loading.builtin import builtin_config
from policy.motion.stick_loop import rates_contract
from policy.nets.toge import TogeConfig
from policy.nets.world_model.config import WorldModelConfig
from policy.training.policy_run import train_policy
from policy.training.report import Hooks, TrainingProgress, TrainResult
from policy.training.run import TrainingStoppedError
from policy.training.settings import RunSettings, TrainSettings, WorldModelSettings
from policy.training.world_model_run import train_world_model


def run_policy_training(paths: Sequence[Path], settings: TrainSettings) -> int:
    """Train a policy; return 0 when the checkpoint is written, 130 if interrupted.

    Paths are flight folders, folders of them, or LeRobot datasets.
    """
    require_device(settings.device)
    network = builtin_config(settings.policy, image_size=settings.image_size)
    flights = _read_flights(paths, settings)
    blind = [flight.name for flight in flights if not np.isfinite(flight.gate).any()]
    if settings.only_end and blind:
        raise UserError(
            "--only-end needs flights that say where the gates were, as mavbridge demonstrate "
            f"writes them; {blind[0]} does not, so all of it would count as the end: leave it out"
        )
    network = fit_to_flights(network, flights, settings)
    return _finish(lambda hooks: train_policy(flights, network, settings, hooks))


def run_world_model_training(paths: Sequence[Path], settings: WorldModelSettings) -> int:
    """Train a world model; see ``run_policy_training``."""
    require_device(settings.device)
    config = WorldModelConfig(image_size=settings.image_size)
    flights = _read_flights(paths, settings)
    flown = common_contract(flights)
    if (action := flown.action) != "sticks":
        raise DatasetError(f"a world model learns from flights by sticks, these were by {action}")
    terms = {name: getattr(flown, name) for name in STICK_TERMS}
    config = replace(config, contract=Contract(state_frame=flown.state_frame, **terms))
    return _finish(lambda hooks: train_world_model(flights, config, settings, hooks))


def fit_to_flights(
    network: TogeConfig, flights: Sequence[FlightData], settings: TrainSettings
) -> TogeConfig:
    """Return the network with the flights' frame and actions, and the settings' inputs."""
    flown = common_contract(flights)
    contract = replace(
        network.contract,
        state_frame=flown.state_frame,
        since_exposure=settings.since_exposure,
        hover_thrust=flown.hover_thrust,
        max_tilt_deg=flown.max_tilt_deg,
        stops_at_end=flown.stops_at_end,
    )
    if flown.action == "rates":
        return replace(network, contract=rates_contract(contract))
    terms = {name: getattr(flown, name) for name in STICK_TERMS}
    return replace(network, contract=replace(contract, **terms))


def _show(bar: Progress, task: TaskID, progress: TrainingProgress) -> None:
    """Show one report of the run: the losses at the end of the bar, all else as lines of text."""
    if progress.note is not None:
        bar.print(f"note: {progress.note}")
        return
    bar.update(task, description=progress.stage, completed=progress.fraction)
    if progress.losses is not None:
        parts = "  ".join(f"{name} {value:.3f}" for name, value in progress.losses.items())
        bar.update(task, status=f"step {progress.step}  {parts.replace('_', ' ')}")
    if progress.validation is not None:
        bar.print(
            f"{progress.fraction:4.0%} {progress.stage}, step {progress.step}: "
            f"{progress.validation.describe()}"
        )


def _finish(train: Callable[[Hooks], TrainResult]) -> int:
    clock = MonotonicClock()
    try:
        with (
            stop_on_signals() as stop,
            progress_bar(text_console(stderr=True), as_percentage=True) as bar,
        ):
            result = train(
                Hooks(
                    now_s=lambda: clock.now_ns() / NS_PER_S,
                    report=partial(_show, bar, bar.add_task("starting", total=1.0, status="")),
                    should_stop=stop.is_set,
                )
            )
    except TrainingStoppedError as stopped:
        text_console(stderr=True).print(str(stopped), style="yellow")
        return INTERRUPTED
    console = text_console()
    console.print(f"{result.checkpoint}: {result.steps} steps", soft_wrap=True)
    if result.validation is not None:
        console.print(result.validation.describe(), soft_wrap=True)
    return 0


def _read_flights(paths: Sequence[Path], settings: RunSettings) -> list[FlightData]:
    camera_key = settings.camera_key
    datasets = dict.fromkeys(path.resolve() for path in paths if is_lerobot(path))
    own = [path for path in paths if not is_lerobot(path)]
    folders = find_flights(own) if own else []
    folders, note = leave_out_failed(folders, include_failed=settings.include_failed)
    console = text_console(stderr=True)
    if note is not None:
        console.print(note, soft_wrap=True)
    flights, warnings = read_flights(folders, camera_key)
    several = [flight for flight in flights if len(flight.contract.cameras) > 1]
    if several and camera_key is None:
        name, cameras = several[0].name, list(several[0].contract.cameras)
        raise UserError(f"{name}: several cameras {cameras}: name one by --camera-key")
    if camera_key is not None and not (several or datasets):
        raise UserError("--camera-key names one of several cameras; these flights have one")
    if len(names := {flight.contract.cameras[0] for flight in flights}) > 1 and not several:
        warnings.append(f"cameras {', '.join(sorted(names))} are taken for one and the same")
    print_warnings(console, warnings + [text for flight in flights for text in flight.damage])
    return flights + [flight for path in datasets for flight in read_dataset(path, camera_key)]
