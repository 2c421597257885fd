"""A stored budget, compared by ratio: two things of one run, so that no machine is too slow for it.

The file is JSON, ``{"ratios": {name: most}}``; the names are those of ``ratios``. Every ratio is
the smaller the better.
"""

import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path

from mavbridge.commands.bench.engines import EAGER
from mavbridge.commands.bench.flights import NAIVE_NAME, OURS_NAME
from mavbridge.commands.bench.link import BARE
from mavbridge.commands.bench.results import BenchResult, Flight, flight_label
from mavbridge.core.errors import UserError


def ratios(result: BenchResult) -> dict[str, float]:
    """Every ratio that the run allows, by name.

    kernels: an engine over the roofline in f32, and over the eager engine. flights: our period over
    the asked one, and period, state-to-wire and processor time an action over the usual runner's.
    link: what our loop adds once it is awake, over the bare pymavlink loop's round trip.
    """
    return dict((*_kernel_ratios(result), *_flight_ratios(result), *_link_ratios(result)))


def _kernel_ratios(result: BenchResult) -> Iterator[tuple[str, float]]:
    floors = {roof.work: roof.floor_ms for roof in result.rooflines if roof.precision == "f32"}
    eager = {kernel.work: kernel.p50_ms for kernel in result.kernels if kernel.engine == EAGER}
    for kernel in result.kernels:
        name = f"{kernel.work}: {kernel.engine}"
        if kernel.work in floors:
            yield f"{name} / roofline f32", kernel.p50_ms / floors[kernel.work]
        if kernel.engine != EAGER and kernel.work in eager:
            yield f"{name} / {EAGER}", kernel.p50_ms / eager[kernel.work]


def _flight_ratios(result: BenchResult) -> Iterator[tuple[str, float]]:
    usual = {flight.policy: flight for flight in result.flights if flight.runner == NAIVE_NAME}
    for flight in result.flights:
        if flight.runner != OURS_NAME or not flight.action_hz:
            continue
        naive = usual.get(flight.policy)
        # Without the precision, which is the processor's: one budget serves them all.
        engine = flight.engine.partition("-")[0]
        name = f"flight: {flight_label(flight.policy, engine, flight.head_steps)}"
        yield f"{name} period / asked period", flight.asked_action_hz / flight.action_hz
        if naive is None or not naive.action_hz:
            continue
        yield f"{name} period / {NAIVE_NAME}", naive.action_hz / flight.action_hz
        yield f"{name} cpu an action / {NAIVE_NAME}", _cpu_ratio(flight, naive)
        ours, theirs = flight.state_to_wire_ms, naive.state_to_wire_ms
        if ours is not None and theirs is not None and theirs.p50 > 0:
            yield f"{name} state to wire / {NAIVE_NAME}", ours.p50 / theirs.p50


def _cpu_ratio(flight: Flight, naive: Flight) -> float:
    if not (flight.action_hz and naive.action_hz and naive.cpu_cores):
        return math.inf
    return (flight.cpu_cores / flight.action_hz) / (naive.cpu_cores / naive.action_hz)


def _link_ratios(result: BenchResult) -> Iterator[tuple[str, float]]:
    bare = next((link for link in result.links if link.client == BARE), None)
    if bare is None or bare.round_trip_ms.p50 <= 0:
        return
    for link in result.links:
        if link.work_ms is not None:
            yield f"link: {link.client} work / {BARE}", link.work_ms.p50 / bare.round_trip_ms.p50


def read_budget(path: Path) -> dict[str, float]:
    """Name -> most.

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
    """What regressed, and what the budget names but the run did not measure; one line each."""
    lines = []
    for name, most in budget.items():
        if name not in measured:
            known = ", ".join(sorted(measured)) or "nothing"
            lines.append(f"{name}: not measured in this run (measured: {known})")
        elif not measured[name] <= most:
            lines.append(f"{name}: {measured[name]:.3g}, at most {most:.3g} is allowed")
    return tuple(lines)
