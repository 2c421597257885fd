"""Results of a benchmark as frozen values, their JSON, and tables of them."""

import json
import os
import platform
import sys
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, is_dataclass
from importlib.metadata import version
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from mavbridge.commands.output import make_table, number
from mavbridge.config.policy import PolicyConfig
from mavbridge.core.vehicle import Percentiles

OURS, BASELINE = "mavbridge", "baseline"


@dataclass(frozen=True, kw_only=True)
class Machine:
    """The computer of a run."""

    cpu: str
    cores: int
    python: str
    torch: str


@dataclass(frozen=True, kw_only=True)
class EngineTiming:
    """One piece of inference on one engine and one thread."""

    policy: str
    work: str
    engine: str
    """Or a bound, such as a roofline."""
    p50_ms: float
    p99_ms: float


@dataclass(frozen=True, kw_only=True)
class Flight:
    """Both loops against the simulated vehicle, from the policy's first action to its last.

    None = not measured.
    """

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
    """All sends, those between two slots as well."""
    action_hz: float | None
    """Chunks computed."""
    vision_hz: float | None
    missed_slots: int
    """Slots of the stick grid without a send within one period."""
    lateness_ms: Percentiles | None = None
    """From a slot to its send."""
    chunks: int
    late_chunks: int | None = None
    """Chunks that came more than 1.5 periods after the one before."""
    period_ms: Percentiles | None
    """Between two chunks."""
    predict_ms: Percentiles | None
    encode_ms: Percentiles | None
    feature_age_ms: Percentiles | None
    state_to_wire_ms: Percentiles | None
    """From an attitude's arrival at this computer to the send of the first sticks made from it."""
    cpu_cores: float
    """Processor time of all our processes over elapsed time."""
    guard_cpu_cores: float | None = None
    """The guard's share of it."""
    guard_waited_ms: float | None = None
    """The guard could run, and the kernel ran others."""
    host_took_ms: float | None = None
    """The hypervisor gave processors of this machine to others."""

    @property
    def label(self) -> str:
        """Runner, policy, kind of solve, engine and conditions."""
        parts = (self.runner, self.policy, self.solves, self.engine, self.conditions)
        return ", ".join(filter(None, parts))

    @property
    def missed_fraction(self) -> float:
        """Missed over asked slots."""
        asked = self.asked_stick_hz * self.duration_s
        return self.missed_slots / asked if asked > 0 else 1.0


@dataclass(frozen=True, kw_only=True)
class LinkLatency:
    """The time from an attitude's send by the vehicle to the arrival of its sticks."""

    client: str = ""
    sent: int
    answered: int
    round_trip_ms: Percentiles | None
    """From just before a send to the kernel's stamp of the first answer; None = no answer."""


@dataclass(frozen=True, kw_only=True)
class BenchResult:
    """One run."""

    machine: Machine
    quick: bool
    engines: tuple[EngineTiming, ...]
    flights: tuple[Flight, ...]
    links: tuple[LinkLatency, ...]
    notes: tuple[str, ...]


def name_of(policy: PolicyConfig) -> str:
    """The checkpoint's name, or that of the policy."""
    return policy.policy if policy.checkpoint is None else policy.checkpoint.stem


def solves_of(policy: PolicyConfig) -> str:
    """The kind of solve that makes a policy's chunks, for tables."""
    steps = f"{policy.steps} step" + "s" * (policy.steps > 1)
    return steps if policy.may_be_dual else f"single rate, {steps}"


def this_machine() -> Machine:
    """Describe the computer that runs this."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return Machine(
        cpu=next(names, platform.processor() or "unknown processor"),
        cores=len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1,
        python=platform.python_version(),
        torch=version("torch"),
    )


def to_json(result: object) -> str:
    """A dataclass as JSON, keys in the order of its fields; null = not measured."""
    if not is_dataclass(result) or isinstance(result, type):
        raise TypeError(f"not a dataclass instance: {result!r}")
    return json.dumps(asdict(result), indent=2, allow_nan=False) + "\n"


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
    """A column for each flight, a row for each figure."""
    flights = tuple(flights)
    header = ("", *(f"{one.label}, {one.duration_s:.0f} s".replace(", ", "\n") for one in flights))
    rows = [(name, *(cell(one) for one in flights)) for name, cell in _FLIGHT_ROWS]
    title = "Both loops against the simulated vehicle (p50 / p99 / max)"
    return make_table(title, header, rows)


def link_table(links: Iterable[LinkLatency]) -> Table:
    """A row for each client."""
    rows = [
        (link.client, f"{link.answered} of {link.sent}", spread(link.round_trip_ms, 2))
        for link in links
    ]
    title = "Link alone: attitude out of the vehicle to sticks back in, ms (p50 / p99 / max)"
    return make_table(title, ("client", "answered", "round trip"), rows)
