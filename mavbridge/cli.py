"""The command line: every flag is a field of a config dataclass."""

import sys
import tomllib
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter
from cyclopts.config import Toml

import mavbridge
from mavbridge.commands.train.checks import prepare as prepare_training
from mavbridge.config.bench import BenchConfig, RolloutBenchConfig
from mavbridge.config.demonstrate import DemonstrateConfig
from mavbridge.config.evaluate import EvaluateConfig
from mavbridge.config.export import ExportConfig
from mavbridge.config.flight import FlyConfig
from mavbridge.config.imagine import ImagineConfig, ImagineEvaluateConfig
from mavbridge.core.errors import UserError
from policy.training.settings import TrainSettings, WorldModelSettings

cli = App(
    name="mavbridge",
    help="Fly an ArduPilot or PX4 vehicle with a vision policy.",
    version=mavbridge.__version__,
)


@cli.command(name="fly")
@cli.default
def fly(config: FlyConfig | None = None) -> int:
    """Fly. Nothing is armed and no mode is changed unless asked."""
    if config is None or not config.link.connect:
        raise UserError("name the vehicle: --connect udp:127.0.0.1:14550 (see --help)")
    from mavbridge.flight.app import fly as run_flight

    return run_flight(config)


bench_cli = App(name="bench")
cli.command(bench_cli)


@bench_cli.default
def bench(config: BenchConfig | None = None) -> int:
    """Measure this machine: engines, loops against a simulated vehicle, the link, the peers."""
    from mavbridge.commands.bench.run import bench as run_bench

    return run_bench(BenchConfig() if config is None else config)


@bench_cli.command(name="rollout")
def bench_rollout(config: RolloutBenchConfig | None = None) -> int:
    """Measure imagined flights: the plain serial way against ours."""
    from mavbridge.recording.folder import require_extra

    require_extra("bench rollout")
    from mavbridge.commands.bench.rollout import bench_rollout as run_bench

    return run_bench(RolloutBenchConfig() if config is None else config)


WORLD_MODEL_FLAG = ("--policy world-model", "--policy=world-model")
IMAGINE, EVALUATE = "imagine", "--evaluate"
imagine_cli = App(name=IMAGINE)
cli.command(imagine_cli)


@imagine_cli.default
def imagine(config: ImagineConfig) -> int:
    """Let a policy and a world model imagine a flight, from the start of a recorded one."""
    from mavbridge.recording.folder import require_extra

    require_extra("imagine")
    from mavbridge.commands.imagine.run import imagine as run_rollout

    return run_rollout(config)


@imagine_cli.command(name=EVALUATE)
def imagine_evaluate(*flights: Path, config: ImagineEvaluateConfig | None = None) -> int:
    """Say how good a world model is, on recorded flights.

    Args:
        flights: flight folders, or folders of them, that the model was not trained on.
        config: the settings.
    """
    from mavbridge.recording.folder import require_extra

    require_extra("imagine --evaluate")
    if not flights:
        raise UserError("name the flights to imagine: mavbridge imagine --evaluate DIR...")
    from mavbridge.commands.evaluate_imagination.run import evaluate_imagination

    return evaluate_imagination(flights, config or ImagineEvaluateConfig())


@cli.command
def evaluate(config: EvaluateConfig | None = None) -> int:
    """Fly a policy over many simulated gate courses, and say how well it does."""
    try:
        from mavbridge.commands.evaluate.run import evaluate as run_evaluation
    except ModuleNotFoundError as error:
        if error.name != "mujoco":
            raise
        raise UserError(
            "evaluate needs the simulator's dynamics: pip install 'mavbridge[sitl]'"
        ) from error
    return run_evaluation(EvaluateConfig() if config is None else config)


@cli.command
def demonstrate(config: DemonstrateConfig) -> int:
    """Record flights of simulated gate courses by an expert, to learn from."""
    from mavbridge.recording.folder import require_extra

    require_extra("demonstrate")
    try:
        from mavbridge.commands.demonstrate.run import demonstrate as run_demonstrations
    except ModuleNotFoundError as error:
        if error.name != "mujoco":
            raise
        raise UserError(
            "demonstrate needs the simulator's dynamics: pip install 'mavbridge[sitl]'"
        ) from error
    return run_demonstrations(config)


@cli.command
def train(*flights: Path, settings: Annotated[TrainSettings, Parameter(name="*")]) -> int:
    """Train a policy from flights.

    Args:
        flights: flight folders, folders of them, or LeRobot datasets (v3).
        settings: the settings.
    """
    prepare_training("train", flights, settings)
    from mavbridge.commands.train.run import run_policy_training

    return run_policy_training(flights, settings)


@cli.command
def train_world_model(
    *flights: Path, settings: Annotated[WorldModelSettings, Parameter(name="*")]
) -> int:
    """Train the world model of mavbridge imagine from flights.

    Args:
        flights: flight folders, folders of them, or LeRobot datasets (v3).
        settings: the settings.
    """
    prepare_training("train-world-model", flights, settings)
    from mavbridge.commands.train.run import run_world_model_training

    return run_world_model_training(flights, settings)


@cli.command
def export(*flights: Path, config: ExportConfig) -> int:
    """Make a LeRobot dataset (v3.0) of flights. Demonstrations that failed are left out.

    Args:
        flights: flight folders, or folders of them.
        config: the settings.
    """
    from mavbridge.recording.folder import require_extra

    require_extra("export")
    from mavbridge.commands.export.run import export as run_export

    if not flights:
        raise UserError("name the flights to export: mavbridge export DIR... --out DIR")
    return run_export(flights, config)


@cli.meta.default
def with_config(
    *tokens: Annotated[str, Parameter(show=False, allow_leading_hyphen=True)],
    config: Path | None = None,
) -> int:
    """Read the settings file, then the command line on top of it.

    Args:
        tokens: the rest of the command line.
        config: TOML file with flags as keys; flags given on the command line win.
    """
    if config is not None:
        _check_toml(config)
    cli.config = [] if config is None else [Toml(config, use_commands_as_keys=False)]
    status: int | None = cli(_command_first(_current_spelling(tokens)))
    return status or 0


def _command_first(tokens: tuple[str, ...]) -> tuple[str, ...]:
    """``--evaluate`` is a command and looks like a flag: it may come wherever a flag may."""
    if tokens[:1] != (IMAGINE,) or EVALUATE not in tokens:
        return tokens
    rest = [token for token in tokens[1:] if token != EVALUATE]
    return IMAGINE, EVALUATE, *rest


def _current_spelling(tokens: tuple[str, ...]) -> tuple[str, ...]:
    """``train --policy world-model`` was the spelling of ``train-world-model`` in version 0.1."""
    for at in range(1, len(tokens)):
        length = 1 if tokens[at] == "--policy=world-model" else 2
        if tokens[0] == "train" and " ".join(tokens[at : at + length]) in WORLD_MODEL_FLAG:
            note = "note: train --policy world-model is now spelled train-world-model\n"
            sys.stderr.write(note)
            rest = (*tokens[1:at], *tokens[at + length :])
            return "train-world-model", *filter("--freeze-encoder".__ne__, rest)
    return tokens


def _check_toml(path: Path) -> None:
    try:
        tomllib.loads(path.read_text())
    except OSError as error:
        raise UserError(f"--config {path}: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UserError(f"--config {path} is not TOML: {error}") from error
