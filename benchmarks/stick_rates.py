"""Exactness of the sticks: flights at several stick rates, with an idle and a busy flight process.

python -m benchmarks.stick_rates                                   all cases, 20 s each
python -m benchmarks.stick_rates --rates 100 --loads none --realtime --duration 600
python -m benchmarks.stick_rates --rates 100 --loads none --realtime --starts 6

The policy is the shipped one, as ``make fly`` flies it; ``benchmarks.loaded_flight`` describes the
loads. A slot is missed when nothing was sent within one period; lateness is from a slot to its
send; the latency from a new attitude depends on the phase between the vehicle and the guard, which
is another one at every start.
"""

import sys
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

from cyclopts import App
from rich.console import Console
from rich.table import Table
from rich.text import Text

from benchmarks.compare import SHIPPED
from benchmarks.flight import fly
from benchmarks.loaded_flight import Load
from benchmarks.results import (
    Flight,
    Machine,
    causes,
    spread,
    this_machine,
    to_json,
)
from mavbridge.commands.output import make_table, number, require_outputs, table_console
from mavbridge.config.policy import Engine, PolicyConfig
from mavbridge.config.rates import Rates
from mavbridge.core.errors import UserError

LOADED_FLIGHT = "benchmarks.loaded_flight"
RATES_HZ = (100.0, 250.0, 400.0)
LOADS: tuple[Load, ...] = get_args(Load)
app = App(help=__doc__)


@dataclass(frozen=True, kw_only=True)
class Case:
    """One flight and its conditions."""

    load: Load
    realtime: bool
    """SCHED_FIFO for guard and policy, where the system permits it."""
    flight: Flight


@dataclass(frozen=True, kw_only=True)
class StickRates:
    """One run."""

    machine: Machine
    cases: tuple[Case, ...]


@app.default
def main(
    *,
    rates: tuple[float, ...] = RATES_HZ,
    loads: tuple[Load, ...] = LOADS,
    realtime: bool | None = None,
    engine: Engine = "openvino",
    duration: float = 20.0,
    starts: int = 1,
    json: Path | None = None,
) -> int:
    """Fly every case in turn and print a table; 1 if a flight is missing from it.

    Parameters
    ----------
    rates
        Stick rates in Hz.
    loads
        What keeps the flight process busy.
    realtime
        With SCHED_FIFO, or without it (--no-realtime); by default both.
    engine
        The policy's engine.
    duration
        Seconds of each flight.
    starts
        Flights of each case.
    json
        Write all figures here.
    """
    require_outputs(json, None)
    schedulings = (True, False) if realtime is None else (realtime,)
    conditions = [
        (rate_hz, load, is_realtime)
        for _ in range(starts)
        for rate_hz in rates
        for load in loads
        for is_realtime in schedulings
    ]
    policy, console = replace(SHIPPED, engine=engine), table_console()
    cases: list[Case] = []
    try:
        for condition in conditions:
            cases += _fly_case(policy, condition, duration, console)
    except KeyboardInterrupt:
        console.print("interrupted: what was measured before follows")
    console.print(case_table(cases))
    if json is not None:
        json.write_text(to_json(StickRates(machine=this_machine(), cases=tuple(cases))))
    return 0 if len(cases) == len(conditions) else 1


def _fly_case(
    policy: PolicyConfig, condition: tuple[float, Load, bool], duration_s: float, console: Console
) -> list[Case]:
    """The case of one flight; none, and a line for the user, if it failed."""
    rate_hz, load, is_realtime = condition
    rates, flags = Rates(stick_rate=rate_hz, realtime=is_realtime), ("--load", load)
    try:
        flight = fly(policy, rates, duration_s, module=LOADED_FLIGHT, flags=flags)
    except UserError as error:
        console.print(Text(f"{rate_hz:g} Hz, load {load}: {error}", style="red"))
        return []
    return [Case(load=load, realtime=is_realtime, flight=flight)]


def case_table(cases: Iterable[Case]) -> Table:
    """A row for each flight."""
    rows = [
        (
            f"{case.flight.asked_stick_hz:g}",
            case.load,
            "yes" if case.realtime else "no",
            f"{case.flight.missed_slots} ({case.flight.missed_fraction:.3%})",
            causes(case.flight.missed_by_cause),
            spread(case.flight.lateness_ms, 3),
            f"{number(case.flight.late_chunks, 0)} of {case.flight.chunks}",
            number(case.flight.predict_ms.max if case.flight.predict_ms else None, 1),
            spread(case.flight.state_to_wire_ms),
        )
        for case in cases
    ]
    header = (
        *("Hz", "load", "FIFO", "missed", "by cause", "lateness"),
        *("late chunks", "slowest solve", "attitude to wire"),
    )
    return make_table("Sticks, ms (p50 / p99 / max)", header, rows, left_columns=3)


if __name__ == "__main__":
    sys.exit(app())
