"""This machine with mavbridge, beside a roofline, a baseline runner and other MAVLink clients.

python -m benchmarks.compare --json bench.json --plot bench.png --check benchmarks/budget.json

Engines and flights with the shipped policy (ResNet-8, 96 pixels) and with an untrained one
(EfficientNet-B3, 224 pixels); MAVSDK where .venv-peers has it.
"""

import sys
from dataclasses import replace

from cyclopts import App

from benchmarks.roofline import time_rooflines
from mavbridge.commands.bench.config import BenchOutputs
from mavbridge.commands.bench.engines import EAGER, time_engines
from mavbridge.commands.bench.flight import FLIGHT_PROCESS, fly
from mavbridge.commands.bench.link import OUR_CLIENT, LinkClient, time_link
from mavbridge.commands.bench.results import BenchResult, this_machine
from mavbridge.commands.bench.run import BARE_CLIENT, QUICK, Effort, run_and_report
from mavbridge.config.policy import PolicyConfig
from mavbridge.config.rates import Rates
from mavbridge.core.processes import IMPORT_ROOT

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
app = App(help=__doc__)


@app.default
def main(outputs: BenchOutputs | None = None) -> int:
    """Measure everything; 1 if the budget is exceeded, 130 if interrupted."""
    return run_and_report(outputs or BenchOutputs(), measure)


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


if __name__ == "__main__":
    sys.exit(app())
