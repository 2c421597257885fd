"""Measure mavbridge on this machine, beside a roofline, a baseline and other MAVLink clients.

python -m benchmarks.compare --json bench.json --check benchmarks/budget.json

Engines and flights use the shipped policy (ResNet-8, 96 pixels) and an untrained one
(EfficientNet-B3, 224 pixels). MAVSDK is included if .venv-peers has it.

Each ratio of the budget compares two figures of one run, so that no machine is too slow for it.
Smaller is better. The file is JSON, ``{"ratios": {name: most}}``, with the names of ``ratios``.
"""

import math
import sys
from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from json import dumps, loads
from pathlib import Path

from cyclopts import App
from rich.text import Text

from benchmarks.engines import EAGER, time_engines
from benchmarks.flight import FLIGHT_PROCESS, Load, fly
from benchmarks.link import BARE_CLIENT, link_clients, time_link
from benchmarks.results import BASELINE, OURS, BenchResult, Flight, print_result
from benchmarks.roofline import time_rooflines
from mavbridge.commands.check.computer import this_computer
from mavbridge.commands.output import print_status, table_console
from mavbridge.config.policy import PolicyConfig
from mavbridge.config.rates import Rates
from mavbridge.core.errors import UserError
from mavbridge.core.extras import require_packages
from mavbridge.core.files import require_writable

BASELINE_PROCESS = "benchmarks.baseline"
SHIPPED = PolicyConfig(engine="openvino")
LARGE = replace(SHIPPED, policy="toge:small", allow_untrained=True)
FLIGHTS = (
    (SHIPPED, FLIGHT_PROCESS),
    (replace(SHIPPED, engine=EAGER), BASELINE_PROCESS),
    (LARGE, FLIGHT_PROCESS),
    (replace(LARGE, engine=EAGER), FLIGHT_PROCESS),
    (replace(LARGE, engine=EAGER), BASELINE_PROCESS),
)
LOADED_FLIGHTS: tuple[tuple[Rates, Load], ...] = tuple(
    (Rates(stick_rate=400.0, realtime=realtime), load)
    for load in ("slow", "busy")
    for realtime in (True, False)
)
"""Flights of the shipped policy for stick timing: with slow solves, and with a busy interpreter."""
ROOFLINE = "roofline f32"
MS_PER_S = 1000.0
FLIGHT_S, ATTITUDES = 60.0, 1500
"""Length of a flight, and number of attitudes that each client of the link answers."""

app = App(help=__doc__)


@app.default
def main(*, json: Path | None = None, check: Path | None = None) -> int:
    """Measure everything, print and write; exit with 1 if the budget is exceeded.

    Args:
        json: write all figures here.
        check: compare with this budget of ratios.
    """
    budget = None if check is None else read_budget(check)
    require_writable(json, "--json")
    require_packages("make bench, which flies the simulator,", {"mujoco": "mujoco"})
    console = table_console()
    result = measure()
    print_result(result, console)
    if json is not None:
        json.write_text(dumps(asdict(result), indent=2, allow_nan=False) + "\n")
    if budget is None:
        return 0
    exceeded = violations(ratios(result), budget)
    for line in exceeded:
        console.print(Text(f"over budget: {line}", style="bold red"))
    if not exceeded:
        console.print(Text(f"within the budget of {check}", style="green"))
    return 1 if exceeded else 0


def measure() -> BenchResult:
    """Measure the sections one after the other, since they would disturb each other."""
    policies = tuple(replace(policy, engine="auto") for policy in (SHIPPED, LARGE))
    engines, notes = time_engines(policies, rounds=5, block_s=1.5)
    clients, peer_notes = link_clients()
    return BenchResult(
        machine=this_computer(),
        engines=(*engines, *time_rooflines(policies)),
        flights=(
            *(_fly(policy, Rates(), FLIGHT_S, module=module) for policy, module in FLIGHTS),
            *(_fly(SHIPPED, rates, FLIGHT_S, load=load) for rates, load in LOADED_FLIGHTS),
        ),
        links=tuple(time_link(client, ATTITUDES) for client in clients),
        notes=(*notes, *peer_notes),
    )


def _fly(
    policy: PolicyConfig,
    rates: Rates,
    duration_s: float,
    *,
    module: str = FLIGHT_PROCESS,
    load: Load = "none",
) -> Flight:
    """Fly; fly once more if the first flight was lost, as to a stall of the machine."""
    try:
        return fly(policy, rates, duration_s, module=module, load=load)
    except UserError as error:
        print_status(f"flown again: {error}")
        return fly(policy, rates, duration_s, module=module, load=load)


def ratios(result: BenchResult) -> dict[str, float]:
    """Return all ratios that the run allows, by name.

    Engines: median time over eager torch's and over the roofline. Flights: period over the
    requested one; period, processor time per action and latency over the baseline's with the same
    policy; 99th percentile of the stick lateness over the stick period. Link: round trip over the
    bare loop's.
    """
    found = dict(_flight_ratios(result))
    times = {(one.policy, one.work, one.engine): one.p50_ms for one in result.engines}
    for (policy, work, engine), time_ms in times.items():
        for reference in (EAGER, ROOFLINE):
            least_ms = times.get((policy, work, reference))
            if least_ms and engine != reference and not engine.startswith("roofline"):
                found[f"{policy}, {work}: {engine} / {reference}"] = time_ms / least_ms
    trips = {link.client: link.round_trip_ms.p50 for link in result.links if link.round_trip_ms}
    bare_ms = trips.pop(BARE_CLIENT.name, 0.0)
    for client, trip_ms in trips.items():
        if bare_ms > 0:
            found[f"link: {client}: round trip / {BARE_CLIENT.name}"] = trip_ms / bare_ms
    return found


def _flight_ratios(result: BenchResult) -> Iterator[tuple[str, float]]:
    baselines = {one.policy: one for one in result.flights if one.runner == BASELINE}
    for flight in result.flights:
        if flight.runner != OURS or not flight.action_hz:
            continue
        # Omit the precision, which depends on the processor, so that one budget serves all.
        engine = flight.engine.partition("-")[0]
        parts = (flight.policy, flight.solves, engine, flight.conditions)
        name = f"flight: {', '.join(filter(None, parts))}"
        yield f"{name}: period / asked period", flight.asked_action_hz / flight.action_hz
        if flight.lateness_ms is not None:
            periods = flight.lateness_ms.p99 * flight.asked_stick_hz / MS_PER_S
            yield f"{name}: stick lateness p99 / period", periods
        yield f"{name}: cores in all", flight.cpu_cores
        if flight.guard_cpu_cores is not None:
            yield f"{name}: cores of the guard", flight.guard_cpu_cores
        baseline = baselines.get(flight.policy)
        if baseline is None or not baseline.action_hz or flight.conditions:
            continue
        yield f"{name}: period / {BASELINE}", baseline.action_hz / flight.action_hz
        least_cpu = baseline.cpu_cores / baseline.action_hz
        cpu_ratio = flight.cpu_cores / flight.action_hz / least_cpu if least_cpu else math.inf
        yield f"{name}: cpu an action / {BASELINE}", cpu_ratio
        ours, theirs = flight.state_to_wire_ms, baseline.state_to_wire_ms
        if ours is not None and theirs is not None and theirs.p50 > 0:
            yield f"{name}: state to wire / {BASELINE}", ours.p50 / theirs.p50


def read_budget(path: Path) -> dict[str, float]:
    """Return the largest allowed ratios, by name.

    Raises:
        UserError: no such file, or not a budget.
    """
    try:
        return {str(name): float(most) for name, most in loads(path.read_text())["ratios"].items()}
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise UserError(
            f'--check {path} is no budget, {{"ratios": {{name: most}}}}: {error!r}'
        ) from error


def violations(measured: Mapping[str, float], budget: Mapping[str, float]) -> tuple[str, ...]:
    """Return a line for each ratio that is over the budget or was not measured."""
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
