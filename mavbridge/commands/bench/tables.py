"""A benchmark run as tables for a terminal."""

from collections.abc import Callable, Iterable

from rich.console import Console
from rich.table import Table
from rich.text import Text

from mavbridge.commands.bench.results import BenchResult, Flight, Kernel, Link, Roofline, TopRate
from mavbridge.core.records import Percentiles


def print_result(result: BenchResult, console: Console) -> None:
    """All tables, then what was left out."""
    machine = result.machine
    console.print(
        Text(
            f"{machine.cpu}, {machine.cores} cores, Python {machine.python}, torch {machine.torch}"
        )
    )
    console.print(kernel_table(result.kernels, result.rooflines))
    console.print(flight_table(result.flights))
    console.print(top_rate_table(result.top_rates))
    console.print(link_table(result.links))
    for note in result.notes:
        console.print(Text(note, style="yellow"))


def kernel_table(kernels: Iterable[Kernel], rooflines: Iterable[Roofline]) -> Table:
    """A row for each piece of work, a column for each engine and each roofline."""
    kernels, rooflines = tuple(kernels), tuple(rooflines)
    engines = tuple(dict.fromkeys(kernel.engine for kernel in kernels))
    precisions = tuple(dict.fromkeys(roof.precision for roof in rooflines))
    measured = {(kernel.work, kernel.engine): kernel for kernel in kernels}
    floors = {(roof.work, roof.precision): roof.floor_ms for roof in rooflines}
    table = Table(title="Inference on one thread, ms (p50 / p99)", title_justify="left")
    table.add_column("work")
    for name in (*engines, *(f"roofline {precision}" for precision in precisions)):
        table.add_column(name, justify="right")
    for work in dict.fromkeys(kernel.work for kernel in kernels):
        table.add_row(
            work,
            *(_kernel(measured.get((work, engine))) for engine in engines),
            *(number(floors.get((work, precision)), 2) for precision in precisions),
        )
    return table


def _kernel(kernel: Kernel | None) -> str:
    return "-" if kernel is None else f"{kernel.p50_ms:.2f} / {kernel.p99_ms:.2f}"


_FLIGHT_ROWS: tuple[tuple[str, Callable[[Flight], str]], ...] = (
    ("actions, Hz", lambda f: f"{number(f.action_hz, 1)} of {f.asked_action_hz:g}"),
    ("images, Hz", lambda f: f"{number(f.vision_hz, 1)} of {f.asked_vision_hz:g}"),
    ("missed slots", lambda f: f"{f.missed_slots} ({f.missed_fraction:.2%})"),
    ("of these because of", lambda f: _causes(f)),
    ("action period, ms", lambda f: spread(f.period_ms)),
    ("sample one chunk, ms", lambda f: spread(f.predict_ms)),
    ("encode one image, ms", lambda f: spread(f.encode_ms)),
    ("feature age at send, ms", lambda f: spread(f.feature_age_ms)),
    ("attitude to wire, ms", lambda f: spread(f.state_to_wire_ms)),
    ("gaps at the vehicle, ms", lambda f: _gaps(f)),
    ("processor time, cores", lambda f: number(f.cpu_cores, 2)),
    ("stolen by the host, ms", lambda f: number(f.stolen_ms, 0)),
)


def flight_table(flights: Iterable[Flight]) -> Table:
    """A column for each runner, a row for each figure."""
    flights = tuple(flights)
    table = Table(
        title="Both loops against the simulated vehicle (p50 / p99 / max)", title_justify="left"
    )
    table.add_column("")
    for flight in flights:
        table.add_column(
            f"{flight.runner}\n{flight.label}\n{flight.duration_s:.0f} s", justify="right"
        )
    for name, cell in _FLIGHT_ROWS:
        table.add_row(name, *(cell(flight) for flight in flights))
    return table


def _causes(flight: Flight) -> str:
    causes = flight.missed_by_cause
    if causes is None:
        return "-"
    return ", ".join(f"{cause} {slots}" for cause, slots in causes.items()) or "none"


def _gaps(flight: Flight) -> str:
    vehicle = flight.vehicle
    if vehicle is None or vehicle.gap_p50_ms is None:
        return "-"
    gaps = (vehicle.gap_p50_ms, vehicle.gap_p99_ms, vehicle.gap_max_ms)
    return " / ".join(number(gap, 1) for gap in gaps)


def top_rate_table(top_rates: Iterable[TopRate]) -> Table:
    """A row for each runner."""
    table = Table(
        title="Highest action rate with under 0.1 % missed slots, beside 30 Hz vision",
        title_justify="left",
    )
    table.add_column("runner")
    table.add_column("actions, Hz", justify="right")
    table.add_column("tried: missed slots")
    for top in top_rates:
        tried = ", ".join(
            f"{trial.action_hz:g} Hz: {trial.missed_fraction:.2%}" for trial in top.trials
        )
        lowest = min(trial.action_hz for trial in top.trials) if top.trials else 0
        best = f"under {lowest:g}" if top.action_hz is None else f"{top.action_hz:g}"
        table.add_row(top.label, best, tried)
    return table


def link_table(links: Iterable[Link]) -> Table:
    """A row for each client."""
    table = Table(
        title="Link alone: attitude out of the vehicle to sticks back in, ms (p50 / p99 / max)",
        title_justify="left",
    )
    for name in ("client", "sticks as", "answered", "round trip", "attitude to wire", "work"):
        table.add_column(name, justify="left" if name in ("client", "sticks as") else "right")
    for link in links:
        table.add_row(
            link.client,
            link.output,
            f"{link.answered} of {link.sent}",
            spread(link.round_trip_ms, 2),
            spread(link.state_to_wire_ms, 2),
            spread(link.work_ms, 2),
        )
    return table


def number(value: float | None, digits: int) -> str:
    """A figure, or a dash for what was not measured."""
    return "-" if value is None else f"{value:.{digits}f}"


def spread(percentiles: Percentiles | None, digits: int = 1) -> str:
    """``p50 / p99 / max``."""
    if percentiles is None:
        return "-"
    values = (percentiles.p50, percentiles.p99, percentiles.max)
    return " / ".join(number(value, digits) for value in values)
