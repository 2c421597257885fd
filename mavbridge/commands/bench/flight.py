"""One flight of both loops against the simulated vehicle, each in a process of its own."""

import json
import sys
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from cyclopts import Parameter

from mavbridge.commands.bench.results import Flight, from_json, name_of, solves_of
from mavbridge.commands.output import print_status
from mavbridge.config.policy import PolicyConfig
from mavbridge.config.rates import Rates
from mavbridge.core.errors import UserError
from mavbridge.core.processes import end, free_port, running, wait

FLIGHT_PROCESS = "mavbridge.commands.bench.flight_process"
STARTING_S = 300.0
"""Most that a process may take beside its flight: imports, compiling an engine, arming. A network
of 263 M parameters compiles for one or two minutes."""


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class FlightJob:
    """The command line of a program that flies once and is measured."""

    port: int
    camera: str
    duration: float
    """Seconds from the policy's first action."""
    out: Path
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    rates: Rates = field(default_factory=Rates)


def fly(
    policy: PolicyConfig,
    rates: Rates,
    duration_s: float,
    *,
    module: str = FLIGHT_PROCESS,
    flags: tuple[str, ...] = (),
) -> Flight:
    """Fly once with the program ``module``, which takes the flags of ``FlightJob`` and ``flags``.

    Raises:
        UserError: the program or the vehicle failed; quotes the end of its log.
    """
    label = ", ".join((module, name_of(policy), solves_of(policy), *flags))
    print_status(f"flight of {duration_s:g} s, sticks at {rates.stick_rate:g} Hz: {label}")
    port = free_port()
    camera = f"shm:mavbridge-bench-{port}"
    with TemporaryDirectory(prefix="mavbridge-bench-") as name:
        folder = Path(name)
        report, out = folder / "vehicle.json", folder / "flight.json"
        log, vehicle_log = folder / "flight.log", folder / "vehicle.log"
        job = FlightJob(
            port=port, camera=camera, duration=duration_s, out=out, policy=policy, rates=rates
        )
        vehicle_command = (
            *(sys.executable, "-m", "sitl", "--camera", camera),
            *("--connect", f"udpout:127.0.0.1:{port}", "--report", str(report)),
        )
        with running(*vehicle_command, log=vehicle_log) as vehicle:
            try:
                command = (sys.executable, "-m", module, *to_flags(job), *flags)
                with running(*command, log=log) as process:
                    wait(process, f"python -m {module}", log, duration_s + STARTING_S)
            except UserError:
                if vehicle.poll() is not None:  # then the flight's log is not the reason
                    wait(vehicle, "python -m sitl", vehicle_log, STARTING_S)
                raise
            end(vehicle)
            wait(vehicle, "python -m sitl", vehicle_log, STARTING_S)
        gaps = json.loads(report.read_text())["overrides"]["gap_ms"]
        return replace(from_json(Flight, out.read_text()), vehicle_gap_ms=gaps)


def to_flags(config: FlightJob | PolicyConfig | Rates) -> tuple[str, ...]:
    """The command line that is parsed back into ``config``."""
    flags: list[str] = []
    for each in fields(config):
        name, value = each.name.replace("_", "-"), getattr(config, each.name)
        if isinstance(value, PolicyConfig | Rates):
            flags += to_flags(value)
        elif isinstance(value, bool):
            flags.append(f"--{name}" if value else f"--no-{name}")
        elif value is not None:
            flags += [f"--{name}", str(value)]
    return tuple(flags)
