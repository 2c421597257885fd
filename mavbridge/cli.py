"""The command line: every flag is a field of a config dataclass."""

import os
import sys
import tomllib
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter
from cyclopts.config import Toml

import mavbridge
from mavbridge.config.bench import BenchConfig, RolloutBenchConfig
from mavbridge.config.demonstrate import DemonstrateConfig
from mavbridge.config.evaluate import EvaluateConfig
from mavbridge.config.export import ExportConfig
from mavbridge.config.flight import FlyConfig
from mavbridge.config.imagine import EvaluateImaginationConfig, ImagineConfig
from mavbridge.config.train import TrainConfig
from mavbridge.core.errors import UserError

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


@cli.command
def imagine(config: ImagineConfig) -> int:
    """Let a policy and a world model imagine a flight, from the start of a recorded one."""
    from mavbridge.recording.folder import require_extra

    require_extra("imagine")
    from mavbridge.commands.imagine.run import imagine as run_rollout

    return run_rollout(config)


@cli.command
def evaluate_imagination(*flights: Path, config: EvaluateImaginationConfig | None = None) -> int:
    """Measure how good a world model is, on recorded flights.

    Args:
        flights: flight folders, or folders of them, that the model was not trained on.
        config: the settings.
    """
    from mavbridge.recording.folder import require_extra

    require_extra("evaluate-imagination")
    if not flights:
        raise UserError("name the flights to imagine: mavbridge evaluate-imagination DIR...")
    from mavbridge.commands.evaluate_imagination.run import evaluate_imagination as run_evaluation

    return run_evaluation(flights, config or EvaluateImaginationConfig())


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
def train(*flights: Path, config: TrainConfig | None = None) -> int:
    """Train a policy, or a world model, from flights.

    Args:
        flights: flight folders, folders of them, or LeRobot datasets (v3).
        config: the settings.
    """
    if not flights:
        raise UserError("name the flights to learn from: mavbridge train DIR... --out FILE")
    if config is None or config.out is None:
        raise UserError("name the checkpoint to write: --out FILE.safetensors")
    # torch's threads else spin at every barrier: on a core that somebody else uses too, ten times
    # the time. OpenMP reads it once, as torch is loaded.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    from mavbridge.commands.train.run import train_policy

    return train_policy(flights, config, config.out)


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
    status: int | None = cli(_renamed(tokens))
    return status or 0


def _renamed(tokens: tuple[str, ...]) -> tuple[str, ...]:
    """Replace ``imagine --evaluate``, which was the name of a command until version 0.1."""
    if tokens[:1] != ("imagine",) or "--evaluate" not in tokens:
        return tokens
    print("imagine --evaluate is now called evaluate-imagination", file=sys.stderr)  # noqa: T201
    return ("evaluate-imagination", *(word for word in tokens[1:] if word != "--evaluate"))


def _check_toml(path: Path) -> None:
    try:
        tomllib.loads(path.read_text())
    except OSError as error:
        raise UserError(f"--config {path}: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UserError(f"--config {path} is not TOML: {error}") from error
