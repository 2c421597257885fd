"""The command line: every flag is a field of a config dataclass."""

import difflib
import os
from collections.abc import Sequence
from inspect import signature
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, CycloptsError, Group, Parameter, Token, UnusedCliTokensError, convert
from rich.text import Text

import mavbridge
from mavbridge.commands.config import (
    CheckConfig,
    ContractConfig,
    ExportConfig,
    ExportPolicyConfig,
    IdentifyConfig,
    ImagineConfig,
    InspectConfig,
    RecordConfig,
    ReplayConfig,
    ServeConfig,
)
from mavbridge.config.episodes import DemonstrateConfig, EvaluateConfig
from mavbridge.config.flags import RARE
from mavbridge.config.flight import FlyConfig
from mavbridge.config.settings_files import (
    Settings,
    print_settings,
    untrusted_settings,
    with_settings,
)
from mavbridge.core.errors import UserError
from mavbridge.core.files import require_writable
from mavbridge.core.log import run_log
from mavbridge.core.provenance import printable
from mavbridge.core.realtime import require_supported_system
from mavbridge.recording.folder import require_extra
from policy.adapters.websocket.kind import PACKAGES as REMOTE_PACKAGES
from policy.errors import require_packages
from policy.files import read_toml
from policy.training.settings import TrainSettings, WorldModelSettings

HELP = """Fly an ArduPilot or PX4 vehicle with a vision policy. How to start:

mavbridge check --connect udp:127.0.0.1:14550 --camera 0 --policy ./my_policy.py:MyPolicy

mavbridge --connect udp:127.0.0.1:14550 --camera 0 --policy ./my_policy.py:MyPolicy --arm

`mavbridge fly --help` lists the flags of a flight; `fly` itself may be left out.
"""
FLYING = Group("Fly", sort_key=1)
LEARNING = Group("Learn", sort_key=2)
CONVERTING = Group("Convert and serve policies", sort_key=3)
REVIEWING = Group("Review flights", sort_key=4)

EXIT_CODES = """Exit status: 0 done, and a flight flown and ended in order; 1 a bug of mavbridge;
2 a flag, file or policy that cannot be used; 3 no flight: vehicle, camera or network absent, never
off the ground, or disarmed under the policy; 4 flown, and ended by a fault; 6 flown, and
crashed; 128 + its number: a signal before the flight.
"""


def _shown_default(value: object) -> str | None:
    """Return a default for the help; None for defaults that say nothing, as a flag that is off."""
    return None if value in (False, "", None) else str(value)


def _exactly(hint: Any, tokens: Sequence[Token]) -> Any:
    """Convert words as cyclopts does, but refuse a fraction for an integer, which it rounds."""
    words = [token.value for token in tokens if "." in token.value]
    if hint in (int, int | None) and not all(float(word).is_integer() for word in words):
        raise ValueError
    return convert(hint, tokens)


def _as_ours(error: CycloptsError) -> Text:
    """Format an error of the parser like all other errors."""
    text = str(error)
    if isinstance(error, UnusedCliTokensError):
        text = f"unexpected word {' '.join(error.unused_tokens or ())!r}: flags begin with --"
    return Text.assemble(("error: ", "bold red"), printable(text))


cli = App(
    name="mavbridge",
    help=HELP,
    version=mavbridge.__version__,
    # A word such as [a] is a name, not a list in JSON.
    default_parameter=Parameter(
        show_default=_shown_default, converter=_exactly, json_list=False, json_dict=False
    ),
    error_formatter=_as_ours,
    result_action="return_value",  # the default exits at once, past ``end_process``
)
cli.register_install_completion_command(help="Install completion for this shell (bash, zsh, fish).")
cli.meta.error_formatter = _as_ours
cli.meta.result_action = "return_value"
for _flag in ("--help", "--version", "--install-completion"):
    cli[_flag].group = RARE


def _require_vehicle(connect: str) -> None:
    if not connect:
        raise UserError("name the vehicle: --connect udp:127.0.0.1:14550 (see --help)")
    require_supported_system()


@cli.command(group=FLYING, help_epilogue=EXIT_CODES)
def fly(config: FlyConfig = FlyConfig()) -> int:
    """Fly. The policy gets control by an explicit act only, such as --arm."""
    _require_vehicle(config.link.connect)
    from mavbridge.flight.app import fly as run_flight

    return run_flight(config)


@cli.default
def _fly_by_default(config: Annotated[FlyConfig, Parameter(show=False)] = FlyConfig()) -> int:
    return fly(config)


@cli.command(group=FLYING)
def check(config: CheckConfig = CheckConfig()) -> int:
    """Check whether a flight could begin, and say why not. Takes the flags of the flight.

    --connect none, --policy none and --camera none leave those out. Exit status: 0 go, 3 no-go.
    """
    _require_vehicle(config.flight.link.connect)
    from mavbridge.commands.check import check as run_check

    return run_check(config)


@cli.command(group=FLYING)
def identify(config: IdentifyConfig = IdentifyConfig()) -> int:
    """Compare the vehicle's gains and lags with those of a policy's training."""
    _require_vehicle(config.flight.link.connect)
    from mavbridge.commands.identify import identify as run_identification

    return run_identification(config)


@cli.command(group=LEARNING)
def record(config: RecordConfig) -> int:
    """Record a human pilot's flights to learn from."""
    _require_vehicle(config.vehicle.connect)
    require_extra("record")
    from mavbridge.commands.record import record as run_recording

    return run_recording(config)


@cli.command(group=REVIEWING)
def replay(flight: Path, config: ReplayConfig = ReplayConfig()) -> int:
    """Compute a recorded flight again, and compare the sticks.

    Exit status 5: they differ.

    Args:
        flight: folder of a flight, as --record makes it.
    """
    require_extra("replay")
    from mavbridge.commands.replay import replay as run_replay

    return run_replay(flight, config)


@cli.command(group=REVIEWING)
def inspect(*flights: Path, config: InspectConfig = InspectConfig()) -> int:
    """Report on recorded flights: rates, latency, releases.

    Args:
        flights: flight folders, as --record makes them.
    """
    require_extra("inspect")
    from mavbridge.commands.inspect import inspect as run_inspection

    return run_inspection(flights, config)


@cli.command(group=CONVERTING)
def serve(config: ServeConfig = ServeConfig()) -> int:
    """Serve a policy to other computers, for --policy ws://HOST:PORT."""
    require_packages("serve", *REMOTE_PACKAGES)
    from mavbridge.commands.serve import serve as run_server

    return run_server(config)


@cli.command(group=LEARNING)
def imagine(config: ImagineConfig) -> int:
    """Imagine a flight by a policy and a world model."""
    require_extra("imagine")
    from mavbridge.commands.imagine import imagine as run_rollout

    return run_rollout(config)


@cli.command(group=LEARNING)
def evaluate(config: EvaluateConfig = EvaluateConfig()) -> int:
    """Fly a policy over many simulated courses, and count the gates."""
    require_packages("evaluate", "mujoco")
    from mavbridge.commands.evaluate import evaluate as run_evaluation

    return run_evaluation(config)


@cli.command(group=LEARNING)
def demonstrate(config: DemonstrateConfig) -> int:
    """Record an expert's flights of simulated courses to learn from."""
    require_extra("demonstrate")
    require_packages("demonstrate", "mujoco")
    from mavbridge.commands.demonstrate import demonstrate as run_demonstrations

    return run_demonstrations(config)


def _prepare_training(
    command: str, flights: Sequence[Path], settings: TrainSettings | WorldModelSettings
) -> None:
    """Check the paths before torch and the flights are loaded."""
    require_extra(command)
    if not flights:
        raise UserError(f"name the flights to learn from: mavbridge {command} DIR... --out FILE")
    for path in flights:
        if not path.is_dir():
            raise UserError(f"{path}: no such folder")
    if not settings.out.parent.is_dir():
        raise UserError(f"--out {settings.out}: there is no folder {settings.out.parent}")
    require_writable(settings.out, "--out")
    if settings.start_from is not None and not settings.start_from.is_file():
        raise UserError(f"--start-from {settings.start_from}: no such file")
    # torch's threads else spin at every barrier: on a core that something else uses too, ten times
    # the time. OpenMP reads it once, as torch is loaded.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")


@cli.command(group=LEARNING)
def train(*flights: Path, settings: Annotated[TrainSettings, Parameter(name="*")]) -> int:
    """Train a policy from flights.

    Args:
        flights: flight folders, folders of them, or LeRobot datasets (v3).
    """
    _prepare_training("train", flights, settings)
    from mavbridge.commands.train import run_policy_training

    return run_policy_training(flights, settings)


@cli.command(group=LEARNING)
def train_world_model(
    *flights: Path, settings: Annotated[WorldModelSettings, Parameter(name="*")]
) -> int:
    """Train the world model of imagine from flights.

    Args:
        flights: flight folders, folders of them, or LeRobot datasets (v3).
    """
    _prepare_training("train-world-model", flights, settings)
    from mavbridge.commands.train import run_world_model_training

    return run_world_model_training(flights, settings)


@cli.command(group=LEARNING)
def export(*flights: Path, config: ExportConfig) -> int:
    """Convert flights to a LeRobot dataset (v3.0), without those that failed, or to MCAP.

    Args:
        flights: flight folders, or folders of them.
    """
    require_extra("export")
    if not flights:
        raise UserError("name the flights to export: mavbridge export DIR... --out DIR")
    if config.format == "mcap":
        require_packages("export --format mcap", "mcap")
        from mavbridge.commands.export_mcap import export as run_export
    else:
        from mavbridge.commands.export import export as run_export
    return run_export(flights, config)


@cli.command(group=CONVERTING)
def export_policy(checkpoint: Path | None = None, *, config: ExportPolicyConfig) -> int:
    """Export a policy as ONNX.

    Args:
        checkpoint: its weights, .safetensors; left out, those that TOGE ships with.
    """
    from mavbridge.commands.convert import export_policy as run_export

    return run_export(checkpoint, config)


@cli.command(group=CONVERTING)
def contract(source: Path, config: ContractConfig = ContractConfig()) -> int:
    """Draft the contract file of a foreign policy.

    Args:
        source: folder of a LeRobot policy, of a LeRobot dataset, or of ONNX files; or one of those.
    """
    from mavbridge.commands.convert import contract as run_contract

    return run_contract(source, config)


@cli.meta.default
def with_config(
    *tokens: Annotated[str, Parameter(show=False, allow_leading_hyphen=True)],
    config: Annotated[Path | None, Parameter(group=RARE)] = None,
    set_config: Annotated[
        tuple[str, ...], Parameter(negative="", group=RARE, show_default=False)
    ] = (),
    print_config: Annotated[bool, Parameter(negative="", group=RARE)] = False,
    trust_config: Annotated[bool, Parameter(negative="", group=RARE)] = False,
    verbose: Annotated[bool, Parameter(name=("--verbose", "-v"), negative="", group=RARE)] = False,
    log_file: Annotated[Path | None, Parameter(group=RARE)] = None,
) -> int:
    """Read the settings file, then the command line on top of it.

    Args:
        tokens: the rest of the command line.
        config: TOML file of flags and further settings; the command line wins.
        set_config: SECTION.NAME=VALUE: one setting, as limits.stall=0.2; repeatable.
        print_config: Print all settings of the command as TOML, and exit.
        trust_config: Let --config name programs, other computers and outside folders.
        verbose: Show details: engine, vehicle, streams, parameters.
        log_file: Append output, details and times to this file.
    """
    _check_command(tokens)
    words = with_settings(tokens, set_config)
    cli.config = []
    if config is not None:
        try:
            document = read_toml(config)
        except OSError as error:
            raise UserError(f"--config {config}: {error.strerror}") from error
        except ValueError as error:
            raise UserError(f"--config {config} is not TOML: {error}") from error
        own = signature(with_config).parameters
        if misplaced := [key for key in document if key.replace("-", "_") in own]:
            raise UserError(
                f"--config {config}: {misplaced[0]} is no key of a file: use the command line"
            )
        for flag, value, what in [] if trust_config else untrusted_settings(document, words):
            raise UserError(
                f"--config {config}: {flag} {value!r} names {what}, which a file may not do by "
                f"itself: give {flag} on the command line, or --trust-config if you know the file"
            )
        cli.config = [Settings(document, source=str(config))]
    if print_config:
        asked = None
        if config is not None or any(word.startswith("-") for word in words):
            bound = cli.parse_args(words)[1]
            bound.apply_defaults()
            *_, asked = bound.arguments.values()
        print_settings(cli[tokens[0]] if tokens and tokens[0] in cli else cli, asked)
        return 0
    with run_log(log_file, verbose=verbose):
        status: int | None = cli(words)
    return status or 0


def _check_command(tokens: tuple[str, ...]) -> None:
    """Raise UserError if the first word is neither a command nor a flag."""
    if not tokens or tokens[0].startswith("-") or tokens[0] in cli:
        return
    commands = sorted(name for name in cli if not name.startswith("-"))
    close = difflib.get_close_matches(tokens[0], commands, n=1)
    hint = f"did you mean {close[0]}?" if close else f"there are {', '.join(commands)}"
    raise UserError(f"unknown command {tokens[0]!r}: {hint}")
