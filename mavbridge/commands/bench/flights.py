"""Both loops against the simulated vehicle: ours, the usual runner, and how fast ours can go."""

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from mavbridge.commands.bench.engines import FLIGHT_POLICY
from mavbridge.commands.bench.processes import end, free_udp_port, running, wait
from mavbridge.commands.bench.results import (
    Flight,
    RateTrial,
    TopRate,
    Vehicle,
    flight_from_json,
    flight_label,
)
from mavbridge.core.errors import UserError

OURS = "mavbridge.commands.bench.flight_process"
NAIVE = "benchmarks.naive"
OURS_NAME, NAIVE_NAME = "mavbridge", "usual runner"
ACTION_HZ, VISION_HZ = 100.0, 30.0
RATES_HZ = (25.0, 50.0, 100.0, 150.0, 200.0, 250.0, 300.0, 400.0, 500.0)
"""Tried in the search for the highest; the last is the most that the bridge takes."""
MAX_MISSED_FRACTION = 0.001
NEARLY_KEPT_FRACTION = 0.05
"""Half a second of ten: what a stall can do."""
STARTING_S = 90.0
"""Most that a process may take beside its flight: imports, compiling an engine, arming."""


@dataclass(frozen=True, kw_only=True)
class Runner:
    """Who flies, and how it computes."""

    module: str
    engine: str
    policy: str = FLIGHT_POLICY
    head_steps: int | None = None
    """Steps of a warm start; None = every chunk is solved in full."""

    @property
    def label(self) -> str:
        """For a person."""
        name = OURS_NAME if self.module == OURS else NAIVE_NAME
        return f"{name}, {flight_label(self.policy, self.engine, self.head_steps)}"


def fly(runner: Runner, *, action_hz: float, duration_s: float) -> Flight:
    """One flight of one runner against a vehicle of its own.

    Raises:
        UserError: the runner or the vehicle failed; with its last words.
    """
    port = free_udp_port()
    camera = f"shm:mavbridge-bench-{port}"
    with TemporaryDirectory(prefix="mavbridge-bench-") as name:
        folder = Path(name)
        vehicle_report, figures = folder / "vehicle.json", folder / "figures.json"
        log, vehicle_log = folder / "runner.log", folder / "vehicle.log"
        vehicle_command = (
            *(sys.executable, "-m", "sitl", "--camera", camera),
            *("--connect", f"udpout:127.0.0.1:{port}", "--report", str(vehicle_report)),
        )
        runner_command: tuple[str, ...] = (
            *(sys.executable, "-m", runner.module, "--port", str(port), "--camera", camera),
            *("--policy", runner.policy, "--engine", runner.engine),
            *("--duration", str(duration_s)),
            *("--action-hz", str(action_hz), "--vision-hz", str(VISION_HZ)),
            *("--out", str(figures)),
        )
        if runner.head_steps is not None:
            runner_command += ("--head-steps", str(runner.head_steps))
        with running(*vehicle_command, log=vehicle_log) as vehicle:
            try:
                with running(*runner_command, log=log) as process:
                    wait(process, f"python -m {runner.module}", log, duration_s + STARTING_S)
            except UserError:
                if vehicle.poll() is not None:  # then the runner's words are not the reason
                    wait(vehicle, "python -m sitl", vehicle_log, STARTING_S)
                raise
            end(vehicle)
            wait(vehicle, "python -m sitl", vehicle_log, STARTING_S)
        return flight_from_json(figures.read_text(), _vehicle(vehicle_report))


def _vehicle(report: Path) -> Vehicle:
    overrides = json.loads(report.read_text())["overrides"]
    gaps = overrides["gap_ms"] or {}
    return Vehicle(
        override_hz=overrides["rate_hz"],
        gap_p50_ms=gaps.get("p50"),
        gap_p99_ms=gaps.get("p99"),
        gap_max_ms=gaps.get("max"),
    )


def top_rate(
    runner: Runner, rates_hz: Sequence[float], duration_s: float, say: Callable[[str], None]
) -> TopRate:
    """The highest action rate that one runner keeps up with beside 30 Hz vision."""
    trials: list[RateTrial] = []

    def missed_fraction(action_hz: float) -> float:
        flight = fly(runner, action_hz=action_hz, duration_s=duration_s)
        trial = RateTrial(
            action_hz=action_hz,
            missed_fraction=round(flight.missed_fraction, 5),
            vision_hz=flight.vision_hz,
        )
        trials.append(trial)
        say(f"{runner.label} at {action_hz:g} Hz: {trial.missed_fraction:.2%} missed")
        return trial.missed_fraction

    action_hz = highest_rate(rates_hz, missed_fraction)
    return TopRate(label=runner.label, action_hz=action_hz, trials=tuple(trials))


def highest_rate(
    rates_hz: Sequence[float], missed_fraction: Callable[[float], float]
) -> float | None:
    """Bisect rising rates for the highest that is kept; None if even the lowest is not.

    A rate that is nearly kept is tried once more: a single stall of a shared host in ten seconds
    is more missed slots than are allowed.
    """
    low, high = 0, len(rates_hz)  # below low all are kept, from high on none
    while low < high:
        middle = (low + high) // 2
        if _is_kept(rates_hz[middle], missed_fraction):
            low = middle + 1
        else:
            high = middle
    return rates_hz[low - 1] if low else None


def _is_kept(rate_hz: float, missed_fraction: Callable[[float], float]) -> bool:
    missed = missed_fraction(rate_hz)
    if MAX_MISSED_FRACTION <= missed < NEARLY_KEPT_FRACTION:
        missed = missed_fraction(rate_hz)
    return missed < MAX_MISSED_FRACTION
