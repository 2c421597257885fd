"""This machine with mavbridge, beside a roofline, a baseline runner and other MAVLink clients.

python -m benchmarks.compare --json bench.json --plot bench.png --check benchmarks/budget.json

Engines and flights with the shipped policy (ResNet-8, 96 pixels) and with an untrained one
(EfficientNet-B3, 224 pixels); MAVSDK where .venv-peers has it.

Each ratio of the budget compares two figures of one run, so that no machine is too slow for it, and
is the smaller the better. The file is JSON, ``{"ratios": {name: most}}``; the names are those of
``ratios``.
"""

import json
import math
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from cyclopts import App, Parameter
from rich.text import Text

from benchmarks.engines import EAGER, time_engines
from benchmarks.flight import FLIGHT_PROCESS, fly
from benchmarks.link import OUR_CLIENT, LinkClient, time_link
from benchmarks.results import (
    BASELINE,
    OURS,
    BenchResult,
    print_result,
    this_machine,
    to_json,
)
from benchmarks.roofline import time_rooflines
from mavbridge.commands.output import require_outputs, table_console
from mavbridge.config.policy import PolicyConfig
from mavbridge.config.rates import Rates
from mavbridge.core.errors import UserError
from mavbridge.core.extras import require_packages
from mavbridge.core.processes import IMPORT_ROOT
from mavbridge.core.stopping import INTERRUPTED

BASELINE_PROCESS = "benchmarks.baseline"
PEERS_PYTHON = IMPORT_ROOT / ".venv-peers" / "bin" / "python"
SHIPPED = PolicyConfig(engine="openvino")
LARGE = replace(SHIPPED, policy="toge:small", allow_untrained=True)
FLIGHTS = (
    (SHIPPED, FLIGHT_PROCESS),
    (replace(SHIPPED, engine=EAGER), BASELINE_PROCESS),
    (LARGE, FLIGHT_PROCESS),
    (replace(LARGE, engine=EAGER), FLIGHT_PROCESS),
    (replace(LARGE, engine=EAGER), BASELINE_PROCESS),
)
ROOFLINE = "roofline f32"
BARE_CLIENT = "bare pymavlink loop"
MS_PER_S = 1000.0

app = App(help=__doc__)


@dataclass(frozen=True, kw_only=True)
class Effort:
    """Durations and repeats of all measurements."""

    engine_rounds: int
    engine_block_s: float
    flight_s: float
    attitudes: int


FULL = Effort(engine_rounds=5, engine_block_s=1.5, flight_s=60.0, attitudes=1500)
QUICK = Effort(engine_rounds=2, engine_block_s=0.5, flight_s=5.0, attitudes=200)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class BenchOutputs:
    """Duration of the measurement, and destinations of its results."""

    quick: bool = False
    """Measure for seconds instead of minutes: figures to look at, not to quote."""
    json: Path | None = None
    """Write all figures here as JSON."""
    plot: Path | None = None
    """Draw the figures here as PNG; needs matplotlib (the extra "bench")."""
    check: Path | None = None
    """Compare with this budget of ratios, and exit with 1 if one is exceeded."""


@app.default
def main(outputs: BenchOutputs | None = None) -> int:
    """Measure everything, print, write and draw; 1 if the budget is exceeded, 130 if interrupted.

    Raises:
        UserError: an output cannot be written, the budget cannot be read, or a package is missing.
    """
    outputs = outputs or BenchOutputs()
    budget = None if outputs.check is None else read_budget(outputs.check)
    require_outputs(outputs.json, outputs.plot)
    require_packages("make bench, which flies the simulator,", {"mujoco": "mujoco"})
    console = table_console()
    try:
        result = measure(QUICK if outputs.quick else FULL)
    except KeyboardInterrupt:
        console.print("interrupted: nothing is written")
        return INTERRUPTED
    print_result(result, console)
    if outputs.json is not None:
        outputs.json.write_text(to_json(result))
    if outputs.plot is not None:
        from benchmarks.figure import make_figure

        make_figure(result).savefig(outputs.plot)
    if budget is None:
        return 0
    exceeded = violations(ratios(result), budget)
    for line in exceeded:
        console.print(Text(f"over budget: {line}", style="bold red"))
    if not exceeded:
        console.print(Text(f"within the budget of {outputs.check}", style="green"))
    return 1 if exceeded else 0


def measure(effort: Effort) -> BenchResult:
    """Measure every section, one after the other: they would disturb each other."""
    policies = tuple(replace(policy, engine="auto") for policy in (SHIPPED, LARGE))
    engines, notes = time_engines(
        policies, rounds=effort.engine_rounds, block_s=effort.engine_block_s
    )
    peers, peer_notes = peer_clients()
    return BenchResult(
        machine=this_machine(),
        quick=effort is QUICK,
        engines=(*engines, *time_rooflines(policies)),
        flights=tuple(
            fly(policy, Rates(), effort.flight_s, module=module) for policy, module in FLIGHTS
        ),
        links=tuple(time_link(client, effort.attitudes) for client in (OUR_CLIENT, *peers)),
        notes=(*notes, *peer_notes),
    )


def peer_clients() -> tuple[tuple[LinkClient, ...], tuple[str, ...]]:
    """Other software's clients of the link test; and why one cannot run here."""
    module = (sys.executable, "-m", "benchmarks.link_pymavlink")
    bare = LinkClient(name=BARE_CLIENT, command=module)
    name = "MAVSDK-Python 4"
    if not PEERS_PYTHON.is_file():
        return (bare,), (f"{name}: not measured, there is no {PEERS_PYTHON} (make bench)",)
    command = (str(PEERS_PYTHON), "-m", "benchmarks.link_mavsdk")
    return (bare, LinkClient(name=name, command=command)), ()


def ratios(result: BenchResult) -> dict[str, float]:
    """Every ratio that the run allows, by name.

    Engines: median time over that of eager torch and over the roofline. Flights: period over the
    asked one; and period, processor time an action and latency over the baseline's with the same
    policy; and the lateness of sticks at the 99th percentile over their period. Link: round trip
    over the bare loop's.
    """
    found = dict(_flight_ratios(result))
    times = {(one.policy, one.work, one.engine): one.p50_ms for one in result.engines}
    for (policy, work, engine), time_ms in times.items():
        for reference in (EAGER, ROOFLINE):
            least_ms = times.get((policy, work, reference))
            if least_ms and engine != reference and not engine.startswith("roofline"):
                found[f"{policy}, {work}: {engine} / {reference}"] = time_ms / least_ms
    bare = next((link for link in result.links if link.client == BARE_CLIENT), None)
    for link in result.links:
        if bare is not None and bare.round_trip_ms.p50 > 0 and link is not bare:
            ratio = link.round_trip_ms.p50 / bare.round_trip_ms.p50
            found[f"link: {link.client}: round trip / {BARE_CLIENT}"] = ratio
    return found


def _flight_ratios(result: BenchResult) -> Iterator[tuple[str, float]]:
    baselines = {one.policy: one for one in result.flights if one.runner == BASELINE}
    for flight in result.flights:
        if flight.runner != OURS or not flight.action_hz:
            continue
        # Without the precision, which depends on the processor: one budget serves them all.
        engine = flight.engine.partition("-")[0]
        name = f"flight: {flight.policy}, {flight.solves}, {engine}"
        yield f"{name}: period / asked period", flight.asked_action_hz / flight.action_hz
        if flight.lateness_ms is not None:
            periods = flight.lateness_ms.p99 * flight.asked_stick_hz / MS_PER_S
            yield f"{name}: stick lateness p99 / period", periods
        baseline = baselines.get(flight.policy)
        if baseline is None or not baseline.action_hz:
            continue
        yield f"{name}: period / {BASELINE}", baseline.action_hz / flight.action_hz
        least_cpu = baseline.cpu_cores / baseline.action_hz
        cpu_ratio = flight.cpu_cores / flight.action_hz / least_cpu if least_cpu else math.inf
        yield f"{name}: cpu an action / {BASELINE}", cpu_ratio
        ours, theirs = flight.state_to_wire_ms, baseline.state_to_wire_ms
        if ours is not None and theirs is not None and theirs.p50 > 0:
            yield f"{name}: state to wire / {BASELINE}", ours.p50 / theirs.p50


def read_budget(path: Path) -> dict[str, float]:
    """The largest allowed ratios, by name.

    Raises:
        UserError: no such file, or not a budget.
    """
    try:
        document = json.loads(path.read_text())
    except OSError as error:
        raise UserError(f"cannot read --check {path}: {error.strerror}") from error
    except ValueError as error:
        raise UserError(f"--check {path} is not JSON: {error}") from error
    entries = document.get("ratios") if isinstance(document, dict) else None
    if not isinstance(entries, dict) or not entries or not all(map(_is_limit, entries.values())):
        raise UserError(
            f'--check {path} is no budget: it must hold {{"ratios": {{name: positive number}}}}'
        )
    return {str(name): float(most) for name, most in entries.items()}


def _is_limit(value: object) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return math.isfinite(value) and value > 0


def violations(measured: Mapping[str, float], budget: Mapping[str, float]) -> tuple[str, ...]:
    """A line for each ratio that is over the budget or was not measured."""
    lines = []
    for name, most in budget.items():
        if name not in measured:
            known = ", ".join(sorted(measured)) or "nothing"
            lines.append(f"{name}: not measured in this run (measured: {known})")
        elif not measured[name] <= most:
            lines.append(f"{name}: {measured[name]:.3g}, at most {most:.3g} is allowed")
    return tuple(lines)


if __name__ == "__main__":
    sys.exit(app())
