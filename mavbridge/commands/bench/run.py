"""The whole benchmark: check the flags, measure, and report."""

from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec

from rich.text import Text

from mavbridge.commands.bench.budget import ratios, read_budget, violations
from mavbridge.commands.bench.engines import time_engines
from mavbridge.commands.bench.flight import fly
from mavbridge.commands.bench.link import OUR_CLIENTS, time_link
from mavbridge.commands.bench.results import BenchResult, print_result, this_machine, to_json
from mavbridge.commands.output import require_outputs, table_console
from mavbridge.config.bench import BenchConfig, BenchOutputs
from mavbridge.core.errors import UserError
from mavbridge.core.stopping import INTERRUPTED


@dataclass(frozen=True, kw_only=True)
class Effort:
    """Durations and repeats of all measurements."""

    engine_rounds: int
    engine_block_s: float
    flight_s: float
    attitudes: int


FULL = Effort(engine_rounds=5, engine_block_s=1.5, flight_s=60.0, attitudes=1500)
QUICK = Effort(engine_rounds=2, engine_block_s=0.5, flight_s=5.0, attitudes=200)


def bench(config: BenchConfig) -> int:
    """Measure one policy; 1 if the budget is exceeded, 130 if interrupted.

    Raises:
        MavbridgeError: a flag, the policy or a process of the benchmark failed.
    """
    return run_and_report(config.outputs, lambda effort: measure(config, effort))


def measure(config: BenchConfig, effort: Effort) -> BenchResult:
    """Measure every section, one after the other: they would disturb each other."""
    engines, notes = time_engines(
        (config.policy,), rounds=effort.engine_rounds, block_s=effort.engine_block_s
    )
    flight = fly(config.policy, config.rates, effort.flight_s)
    links = tuple(time_link(client, effort.attitudes) for client in OUR_CLIENTS)
    return BenchResult(
        machine=this_machine(),
        quick=effort is QUICK,
        engines=engines,
        flights=(flight,),
        links=links,
        notes=notes,
    )


def run_and_report(outputs: BenchOutputs, measure: Callable[[Effort], BenchResult]) -> int:
    """Check the output flags, measure, print, write, draw and compare with the budget.

    Raises:
        UserError: an output cannot be written, the budget cannot be read, or a package is missing.
    """
    budget = None if outputs.check is None else read_budget(outputs.check)
    require_outputs(outputs.json, outputs.plot)
    if find_spec("mujoco") is None:
        raise UserError("bench needs the simulator's dynamics: pip install 'mavbridge[sitl]'")
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
        from mavbridge.commands.bench.figure import make_figure

        make_figure(result).savefig(outputs.plot)
    if budget is None:
        return 0
    exceeded = violations(ratios(result), budget)
    for line in exceeded:
        console.print(Text(f"over budget: {line}", style="bold red"))
    if not exceeded:
        console.print(Text(f"within the budget of {outputs.check}", style="green"))
    return 1 if exceeded else 0
