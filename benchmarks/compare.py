"""Measure mavbridge on this machine, beside eager torch and other MAVLink clients.

python -m benchmarks.compare --json bench.json

Engines run the shipped policy (ResNet-8, 96 pixels) and an untrained one (ResNet-50, 224
pixels). The flight is ``mavbridge check --soak`` with the shipped policy. MAVSDK is included if
.venv-peers has it.

Each ratio of the budget compares two figures of one run, so that no machine is too slow for it.
Smaller is better.
"""

import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from json import loads
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from cyclopts import App
from rich.text import Text

from benchmarks.engines import EAGER, FAST, EngineTiming, engine_table, time_engines
from benchmarks.link import BARE_CLIENT, link_clients, link_table, time_link
from benchmarks.link_vehicle import LinkLatency
from mavbridge.commands.output import table_console, write_json
from mavbridge.config.policy import PolicyConfig
from mavbridge.core.errors import UserError
from mavbridge.core.files import require_writable
from policy.errors import require_packages

TIMED: tuple[PolicyConfig, ...] = tuple(
    PolicyConfig(policy=policy, allow_untrained=is_untrained, engine=engine)
    for policy, is_untrained in (("toge", False), ("toge:small:resnet50", True))
    for engine in (EAGER, FAST)
)
FLIGHT_S, ATTITUDES = 60, 1500
"""Length of the flight, and number of attitudes that each client of the link answers."""
MS_PER_S = 1000.0
BUDGET: Mapping[str, float] = {
    "toge:small:resnet50, encode one image: openvino / torch": 0.6,
    "toge:small:resnet50, sample one chunk: openvino / torch": 0.4,
    "toge, encode one image: openvino / torch": 0.6,
    "toge, sample one chunk: openvino / torch": 0.4,
    "flight: period / asked period": 1.05,
    "flight: stick lateness p99 / period": 0.1,
    "flight: cores in all": 1.0,
    "flight: cores of the guard": 0.3,
    "link: mavbridge: round trip / bare pymavlink loop": 8.0,
}
"""Largest allowed ratios."""
app = App(help=__doc__)


@dataclass(frozen=True, kw_only=True)
class BenchResult:
    """Results of one run."""

    engines: tuple[EngineTiming, ...]
    flight: dict[str, Any]
    """The part ``soak`` of the check's JSON."""
    links: tuple[LinkLatency, ...]
    notes: tuple[str, ...]


@app.default
def main(*, json: Path | None = None) -> int:
    """Measure everything, print and write; exit with 1 if the budget is exceeded.

    Args:
        json: write all figures here.
    """
    require_writable(json, "--json")
    require_packages("make bench, which flies the simulator,", "mujoco")
    console = table_console()
    result = measure()
    console.print(engine_table(result.engines))
    console.print(link_table(result.links))
    for note in result.notes:
        console.print(Text(note, style="yellow"))
    write_json(json, asdict(result))
    exceeded = violations(ratios(result), BUDGET)
    for line in exceeded:
        console.print(Text(f"over budget: {line}", style="bold red"))
    if not exceeded:
        console.print(Text("within the budget", style="green"))
    return 1 if exceeded else 0


def measure() -> BenchResult:
    """Measure the sections one after the other, since they would disturb each other."""
    flight = fly()
    clients, notes = link_clients()
    return BenchResult(
        engines=time_engines(TIMED, rounds=5, block_s=1.5),
        flight=flight,
        links=tuple(time_link(client, ATTITUDES) for client in clients),
        notes=notes,
    )


def fly() -> dict[str, Any]:
    """Check this computer with the shipped policy, printing the table; return the soak's figures.

    Raises:
        UserError: the flight failed; the table says why.
    """
    with TemporaryDirectory(prefix="mavbridge-bench-") as folder:
        out = Path(folder) / "check.json"
        command = (sys.executable, "-m", "mavbridge", "check", "--connect", "none")
        subprocess.run([*command, "--soak", str(FLIGHT_S), "--json", str(out)], check=False)
        soak: dict[str, Any] | None = loads(out.read_text())["soak"] if out.exists() else None
    if soak is None:
        raise UserError("the flight was not measured: mavbridge check says why, above")
    return soak


def ratios(result: BenchResult) -> dict[str, float]:
    """Return all ratios that the run allows, by name.

    Engines: median time over eager torch's. Flight: period over the requested one, 99th percentile
    of the stick lateness over the stick period, and used cores. Link: round trip over the bare
    loop's.
    """
    found = dict(_flight_ratios(result.flight))
    times = {(one.policy, one.work, one.engine): one.p50_ms for one in result.engines}
    for (policy, work, engine), time_ms in times.items():
        eager_ms = times.get((policy, work, EAGER))
        if eager_ms and engine != EAGER:
            found[f"{policy}, {work}: {engine} / {EAGER}"] = time_ms / eager_ms
    trips = {link.client: link.round_trip_ms.p50 for link in result.links if link.round_trip_ms}
    bare_ms = trips.pop(BARE_CLIENT.name, 0.0)
    for client, trip_ms in trips.items():
        if bare_ms > 0:
            found[f"link: {client}: round trip / {BARE_CLIENT.name}"] = trip_ms / bare_ms
    return found


def _flight_ratios(flight: Mapping[str, Any]) -> Iterator[tuple[str, float]]:
    sticks, action = flight["timing"]["sticks"], flight["timing"]["action"]
    cores = flight["cpu_cores"]
    if action["rate_hz"]:
        yield "flight: period / asked period", action["target_hz"] / action["rate_hz"]
    if sticks["lateness_ms"]:
        periods = sticks["lateness_ms"]["p99"] * sticks["target_hz"] / MS_PER_S
        yield "flight: stick lateness p99 / period", periods
    yield "flight: cores in all", cores["flight"] + cores["guard"]
    yield "flight: cores of the guard", cores["guard"]


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
