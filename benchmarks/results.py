"""Results of a benchmark as frozen values, their JSON, and their tables."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from rich.console import Console
from rich.table import Table
from rich.text import Text

from mavbridge.commands.check.computer import Computer
from mavbridge.commands.output import make_table, number
from mavbridge.config.policy import PolicyConfig
from mavbridge.core.vehicle import Percentiles

OURS, BASELINE = "mavbridge", "baseline"


@dataclass(frozen=True, kw_only=True)
class EngineTiming:
    """Time of one piece of inference on one engine and one thread."""

    policy: str
    work: str
    engine: str
    """Engine, or the name of a bound such as a roofline."""
    p50_ms: float
    p99_ms: float


@dataclass(frozen=True, kw_only=True)
class Flight:
    """Figures of both loops against the simulated vehicle, from the policy's first to its last
    action. None = not measured."""

    runner: str
    policy: str
    solves: str
    engine: str
    conditions: str = ""
    """Unusual rate, load or scheduling of this flight, for tables."""
    asked_stick_hz: float
    asked_action_hz: float
    asked_vision_hz: float
    duration_s: float
    stick_hz: float | None
    """All sends per second, including those between two slots."""
    action_hz: float | None
    """Computed chunks per second."""
    vision_hz: float | None
    missed_slots: int
    """Slots of the stick grid without a send within one period."""
    lateness_ms: Percentiles | None = None
    """Time from a slot to its send."""
    chunks: int
    late_chunks: int | None = None
    """Chunks that came more than 1.5 periods after the previous one."""
    period_ms: Percentiles | None
    """Time between two chunks."""
    predict_ms: Percentiles | None
    encode_ms: Percentiles | None
    feature_age_ms: Percentiles | None
    state_to_wire_ms: Percentiles | None
    """Time from an attitude's arrival at this computer to the send of the first sticks made from
    it."""
    cpu_cores: float
    """Processor time of all our processes over elapsed time."""
    guard_cpu_cores: float | None = None
    """The guard's part of ``cpu_cores``."""
    guard_waited_ms: float | None = None
    """Time in which the guard was runnable, but the kernel ran others."""
    host_took_ms: float | None = None
    """Time in which the hypervisor gave this machine's processors to others."""

    @property
    def label(self) -> str:
        """Runner, policy, kind of solve, engine and conditions."""
        parts = (self.runner, self.policy, self.solves, self.engine, self.conditions)
        return ", ".join(filter(None, parts))

    @property
    def missed_fraction(self) -> float:
        """Share of the requested slots that were missed."""
        asked = self.asked_stick_hz * self.duration_s
        return self.missed_slots / asked if asked > 0 else 1.0


@dataclass(frozen=True, kw_only=True)
class LinkLatency:
    """Time from the vehicle's send of an attitude to the arrival of its sticks."""

    client: str = ""
    sent: int
    answered: int
    round_trip_ms: Percentiles | None
    """From just before a send to the kernel's stamp of the first answer; None = no answer."""


@dataclass(frozen=True, kw_only=True)
class BenchResult:
    """Results of one run."""

    machine: Computer
    engines: tuple[EngineTiming, ...]
    flights: tuple[Flight, ...]
    links: tuple[LinkLatency, ...]
    notes: tuple[str, ...]


def name_of(policy: PolicyConfig) -> str:
    """Return the name of the checkpoint, or else of the policy."""
    return policy.policy if policy.checkpoint is None else policy.checkpoint.stem


def solves_of(policy: PolicyConfig) -> str:
    """Return the kind of solve that makes a policy's chunks, for tables."""
    steps = f"{policy.steps} step" + "s" * (policy.steps > 1)
    return steps if policy.may_be_dual else f"single rate, {steps}"


def print_result(result: BenchResult, console: Console) -> None:
    """Print the machine, all tables and the notes."""
    here = result.machine
    python, torch = here.versions["python"], here.versions.get("torch")
    console.print(Text(f"{here.cpu}, {here.cores} cores, Python {python}, torch {torch}"))
    for table in (
        engine_table(result.engines),
        flight_table(result.flights),
        link_table(result.links),
    ):
        console.print(table)
    for note in result.notes:
        console.print(Text(note, style="yellow"))


def spread(percentiles: Percentiles | None, digits: int = 1) -> str:
    """Return p50 / p99 / max, or a dash."""
    if percentiles is None:
        return "-"
    values = (percentiles.p50, percentiles.p99, percentiles.max)
    return " / ".join(number(value, digits) for value in values)


def engine_table(timings: Iterable[EngineTiming]) -> Table:
    """Return a table with a row for each piece of work and a column for each engine."""
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
    ("sticks, Hz", lambda f: f"{number(f.stick_hz, 1)} of {f.asked_stick_hz:g}"),
    ("missed slots", lambda f: f"{f.missed_slots} ({f.missed_fraction:.3%})"),
    ("stick lateness, ms", lambda f: spread(f.lateness_ms, 3)),
    ("chunks, Hz", lambda f: f"{number(f.action_hz, 1)} of {f.asked_action_hz:g}"),
    ("late chunks", lambda f: f"{number(f.late_chunks, 0)} of {f.chunks}"),
    ("images, Hz", lambda f: f"{number(f.vision_hz, 1)} of {f.asked_vision_hz:g}"),
    ("chunk period, ms", lambda f: spread(f.period_ms)),
    ("sample one chunk, ms", lambda f: spread(f.predict_ms)),
    ("encode one image, ms", lambda f: spread(f.encode_ms)),
    ("feature age at send, ms", lambda f: spread(f.feature_age_ms)),
    ("attitude to wire, ms", lambda f: spread(f.state_to_wire_ms)),
    ("processor time, cores", lambda f: number(f.cpu_cores, 2)),
    ("of it the guard", lambda f: number(f.guard_cpu_cores, 2)),
    ("guard waited for a core, ms", lambda f: number(f.guard_waited_ms, 0)),
    ("taken by the host, ms", lambda f: number(f.host_took_ms, 0)),
)


def flight_table(flights: Iterable[Flight]) -> Table:
    """Return a table with a column for each flight and a row for each figure."""
    flights = tuple(flights)
    header = ("", *(f"{one.label}, {one.duration_s:.0f} s".replace(", ", "\n") for one in flights))
    rows = [(name, *(cell(one) for one in flights)) for name, cell in _FLIGHT_ROWS]
    title = "Both loops against the simulated vehicle (p50 / p99 / max)"
    return make_table(title, header, rows)


def link_table(links: Iterable[LinkLatency]) -> Table:
    """Return a table with a row for each client."""
    rows = [
        (link.client, f"{link.answered} of {link.sent}", spread(link.round_trip_ms, 2))
        for link in links
    ]
    title = "Link alone: attitude out of the vehicle to sticks back in, ms (p50 / p99 / max)"
    return make_table(title, ("client", "answered", "round trip"), rows)
