"""The whole benchmark: run the sections, print, write, draw, compare."""

import os
import platform
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from rich.console import Console
from rich.text import Text

from mavbridge.commands.bench import flights, kernels, link
from mavbridge.commands.bench.budget import ratios, read_budget, violations
from mavbridge.commands.bench.engines import EAGER, SHIPPED_POLICY, WARM_STEPS
from mavbridge.commands.bench.processes import require_source_tree
from mavbridge.commands.bench.results import BenchResult, Flight, Machine, to_json
from mavbridge.commands.bench.tables import print_result
from mavbridge.commands.plots import needs_matplotlib
from mavbridge.config.bench import BenchConfig
from mavbridge.core.clock import MonotonicClock
from mavbridge.core.errors import UserError
from mavbridge.core.stopping import INTERRUPTED


@dataclass(frozen=True, kw_only=True)
class _Plan:
    """How long everything takes."""

    kernels: kernels.Effort
    flight_s: float
    rates_hz: tuple[float, ...]
    rate_trial_s: float
    link_repeats: int
    attitudes: int


PIPED_WIDTH = 120
"""Columns of the tables where there is no terminal to ask."""


def table_console(*, highlight: bool = True) -> Console:
    """Where tables are told: as wide as the terminal, or wide enough."""
    console = Console(highlight=highlight)
    if not console.is_terminal:
        console.width = PIPED_WIDTH
    return console


FULL = _Plan(
    kernels=kernels.Effort(repeats=5, block_s=1.5),
    flight_s=60.0,
    rates_hz=flights.RATES_HZ,
    rate_trial_s=10.0,
    link_repeats=3,
    attitudes=500,
)
QUICK = _Plan(
    kernels=kernels.Effort(repeats=2, block_s=0.5),
    flight_s=5.0,
    rates_hz=(25.0, 100.0, 250.0),
    rate_trial_s=4.0,
    link_repeats=1,
    attitudes=200,
)


def bench(config: BenchConfig) -> int:
    """Run everything that the config asks for; 1 if the budget is exceeded, 130 if interrupted.

    Raises:
        MavbridgeError: for whatever a person can have caused.
    """
    require_source_tree()
    # Refused now, not after ten minutes.
    budget = None if config.check is None else read_budget(config.check)
    draw = None if config.plot is None else _drawing(config.plot)
    for path in (config.json, config.plot):
        if path is not None:
            require_folder(path)
    console = table_console()
    try:
        result = measure(QUICK if config.quick else FULL, is_quick=config.quick, say=sayer())
    except KeyboardInterrupt:
        console.print("interrupted: nothing is written")
        return INTERRUPTED
    print_result(result, console)
    if config.json is not None:
        config.json.write_text(to_json(result))
    if draw is not None:
        draw(result)
    if budget is None:
        return 0
    broken = violations(ratios(result), budget)
    for line in broken:
        console.print(Text(f"over budget: {line}", style="bold red"))
    if not broken:
        console.print(Text(f"within the budget of {config.check}", style="green"))
    return 1 if broken else 0


def measure(plan: _Plan, *, is_quick: bool, say: Callable[[str], None]) -> BenchResult:
    """Every section, one after the other: they would disturb each other."""
    clock = MonotonicClock()
    contenders, notes = link.clients()
    return BenchResult(
        machine=machine(),
        quick=is_quick,
        kernels=kernels.measure(plan.kernels, clock, say),
        rooflines=kernels.rooflines(clock),
        flights=_flights(plan, say),
        top_rates=tuple(
            flights.top_rate(runner, plan.rates_hz, plan.rate_trial_s, say)
            for runner in (_SHIPPED, _WARM)
        ),
        links=link.measure(
            contenders, repeats=plan.link_repeats, attitudes=plan.attitudes, say=say
        ),
        notes=notes,
    )


_EAGER = flights.Runner(module=flights.OURS, engine=EAGER)
_FULL = flights.Runner(module=flights.OURS, engine="openvino")
_WARM = flights.Runner(module=flights.OURS, engine="openvino", head_steps=WARM_STEPS)
_NAIVE = flights.Runner(module=flights.NAIVE, engine=EAGER)
_SHIPPED = replace(_WARM, policy=SHIPPED_POLICY)
_NAIVE_SHIPPED = replace(_NAIVE, policy=SHIPPED_POLICY)


def _flights(plan: _Plan, say: Callable[[str], None]) -> tuple[Flight, ...]:
    found = []
    for runner in (_SHIPPED, _NAIVE_SHIPPED, _WARM, _FULL, _EAGER, _NAIVE):
        say(f"flight of {plan.flight_s:g} s: {runner.label}")
        found.append(flights.fly(runner, action_hz=flights.ACTION_HZ, duration_s=plan.flight_s))
    return tuple(found)


def _drawing(path: Path) -> Callable[[BenchResult], None]:
    """What draws the figure to ``path``; looked for before the run."""
    with needs_matplotlib():
        from mavbridge.commands.bench.figure import draw
    return lambda result: draw(result, path)


def require_folder(path: Path) -> None:
    """Make sure that a result can be written there.

    Raises:
        UserError: it cannot.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"cannot write to {path.parent}: {error.strerror}") from error
    if path.is_dir() or not os.access(path.parent, os.W_OK):
        raise UserError(f"cannot write {path}: a folder, or in one that may not be written to")


def sayer() -> Callable[[str], None]:
    """Tells a person what is going on, beside the results."""
    console = Console(stderr=True)
    return lambda line: console.print(Text(line, style="dim"))


def machine() -> Machine:
    """This one."""
    return Machine(
        cpu=_cpu_name(),
        cores=len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1,
        python=platform.python_version(),
        torch=torch.__version__,
    )


def _cpu_name() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor() or "unknown processor")
