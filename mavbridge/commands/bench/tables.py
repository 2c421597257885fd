"""A benchmark's results as tables for a terminal."""

from collections.abc import Callable, Iterable, Mapping

from rich.console import Console
from rich.table import Table
from rich.text import Text

from mavbridge.commands.bench.results import BenchResult, EngineTiming, Flight, LinkLatency
from mavbridge.core.records import Percentiles


def print_result(result: BenchResult, console: Console) -> None:
    """Print the machine, all tables, and what was left out."""
    here = result.machine
    console.print(Text(f"{here.cpu}, {here.cores} cores, Python {here.python}, torch {here.torch}"))
    for table in (
        engine_table(result.engines),
        flight_table(result.flights),
        link_table(result.links),
    ):
        console.print(table)
    for note in result.notes:
        console.print(Text(note, style="yellow"))


def make_table(
    title: str, header: Iterable[str], rows: Iterable[Iterable[str]], *, left_columns: int = 1
) -> Table:
    """A table whose first columns are text and whose others are right-aligned figures."""
    table = Table(title=title, title_justify="left")
    for index, name in enumerate(header):
        table.add_column(name, justify="left" if index < left_columns else "right")
    for row in rows:
        table.add_row(*row)
    return table


def number(value: float | None, digits: int) -> str:
    """A figure, or a dash for what was not measured."""
    return "-" if value is None else f"{value:.{digits}f}"


def spread(percentiles: Percentiles | None, digits: int = 1) -> str:
    """p50 / p99 / max, or a dash."""
    if percentiles is None:
        return "-"
    values = (percentiles.p50, percentiles.p99, percentiles.max)
    return " / ".join(number(value, digits) for value in values)


def engine_table(timings: Iterable[EngineTiming]) -> Table:
    """A row for each piece of work, a column for each engine."""
    cells = {
        (one.policy, one.work, one.engine): f"{one.p50_ms:.2f} / {one.p99_ms:.2f}"
        for one in timings
    }
    engines = tuple(dict.fromkeys(engine for _, _, engine in cells))
    works = tuple(dict.fromkeys((policy, work) for policy, work, _ in cells))
    rows = [
        (policy, work, *(cells.get((policy, work, engine), "-") for engine in engines))
        for policy, work in works
    ]
    title = "Inference on one thread, ms (p50 / p99)"
    return make_table(title, ("policy", "work", *engines), rows, left_columns=2)


_FLIGHT_ROWS: tuple[tuple[str, Callable[[Flight], str]], ...] = (
    ("actions, Hz", lambda f: f"{number(f.action_hz, 1)} of {f.asked_action_hz:g}"),
    ("images, Hz", lambda f: f"{number(f.vision_hz, 1)} of {f.asked_vision_hz:g}"),
    ("missed slots", lambda f: f"{f.missed_slots} ({f.missed_fraction:.2%})"),
    ("by cause", lambda f: _causes(f.missed_by_cause)),
    ("action period, ms", lambda f: spread(f.period_ms)),
    ("sample one chunk, ms", lambda f: spread(f.predict_ms)),
    ("encode one image, ms", lambda f: spread(f.encode_ms)),
    ("feature age at send, ms", lambda f: spread(f.feature_age_ms)),
    ("attitude to wire, ms", lambda f: spread(f.state_to_wire_ms)),
    ("gaps at the vehicle, ms", lambda f: _gaps(f.vehicle_gap_ms)),
    ("processor time, cores", lambda f: number(f.cpu_cores, 2)),
    ("stolen by the host, ms", lambda f: number(f.stolen_ms, 0)),
)


def flight_table(flights: Iterable[Flight]) -> Table:
    """A column for each flight, a row for each figure."""
    flights = tuple(flights)
    header = ("", *(f"{one.label}, {one.duration_s:.0f} s".replace(", ", "\n") for one in flights))
    rows = [(name, *(cell(one) for one in flights)) for name, cell in _FLIGHT_ROWS]
    title = "Both loops against the simulated vehicle (p50 / p99 / max)"
    return make_table(title, header, rows)


def _causes(slots_by_cause: Mapping[str, int] | None) -> str:
    if slots_by_cause is None:
        return "-"
    return ", ".join(f"{cause} {slots}" for cause, slots in slots_by_cause.items()) or "none"


def _gaps(gap_ms: Mapping[str, float] | None) -> str:
    if gap_ms is None:
        return "-"
    return " / ".join(number(gap_ms[name], 1) for name in ("p50", "p99", "max"))


def link_table(links: Iterable[LinkLatency]) -> Table:
    """A row for each client."""
    rows = [
        (
            link.client,
            f"{link.answered} of {link.sent}",
            spread(link.round_trip_ms, 2),
            spread(link.timing.state_to_wire_ms, 2),
            spread(link.timing.work_ms, 2),
        )
        for link in links
    ]
    header = ("client", "answered", "round trip", "attitude to wire", "work")
    title = "Link alone: attitude out of the vehicle to sticks back in, ms (p50 / p99 / max)"
    return make_table(title, header, rows)
