"""What a benchmark run found: frozen values, and their JSON."""

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from statistics import median
from typing import Any

from mavbridge.commands.bench.engines import SHIPPED_POLICY
from mavbridge.core.records import Percentiles


@dataclass(frozen=True, kw_only=True)
class Machine:
    """Where the run took place."""

    cpu: str
    cores: int
    """That this process may use."""
    python: str
    torch: str


@dataclass(frozen=True, kw_only=True)
class Kernel:
    """One piece of inference on one engine, one thread; medians over the repeats."""

    work: str
    engine: str
    p50_ms: float
    p99_ms: float


@dataclass(frozen=True, kw_only=True)
class Roofline:
    """The least time that one piece of inference can take on one thread of this machine."""

    work: str
    precision: str
    gflop: float
    """Counted by torch: convolutions and matrix products."""
    weights_mb: float
    """Bytes of the weights, once for every time that they are used."""
    gflop_per_s: float
    """Of a large matrix product, measured in this run."""
    gb_per_s: float
    """Of reading a buffer as large as the weights over and over, measured in this run."""
    floor_ms: float
    """The larger of compute and weight traffic."""


@dataclass(frozen=True, kw_only=True)
class Vehicle:
    """What the simulated vehicle saw of a flight, on its side of the wire."""

    override_hz: float | None
    """From the first override to the last: with mavbridge, the seconds before arming too."""
    gap_p50_ms: float | None
    gap_p99_ms: float | None
    gap_max_ms: float | None


@dataclass(frozen=True, kw_only=True)
class Flight:
    """Both loops against the vehicle, from the first action of the policy to the last."""

    runner: str
    policy: str
    engine: str
    asked_action_hz: float
    asked_vision_hz: float
    duration_s: float
    action_hz: float | None
    vision_hz: float | None
    missed_slots: int
    """Of the asked grid; for a runner without a grid, actions that did not happen."""
    period_ms: Percentiles | None
    predict_ms: Percentiles | None
    encode_ms: Percentiles | None
    feature_age_ms: Percentiles | None
    """Exposure to send."""
    state_to_wire_ms: Percentiles | None
    """Arrival of an attitude at the host to the send of the first sticks made from it."""
    cpu_cores: float
    """Processor time of the bridge's process over elapsed time."""
    stolen_ms: float | None
    """Processor time that the host took from this machine meanwhile; None = not known."""
    missed_by_cause: Mapping[str, int] | None
    """Missed slots by ``attribution.Cause``; None = this runner is not watched."""
    head_steps: int | None = None
    """Steps of a warm start; None = every chunk is solved in full."""
    vehicle: Vehicle | None = None

    @property
    def label(self) -> str:
        """Engine and kind of solve, and the policy if it is the one that ships."""
        return flight_label(self.policy, self.engine, self.head_steps)

    @property
    def missed_fraction(self) -> float:
        """Missed over asked slots."""
        asked = self.asked_action_hz * self.duration_s
        return self.missed_slots / asked if asked > 0 else 1.0


def flight_label(policy: str, engine: str, head_steps: int | None) -> str:
    """What flies, for a person."""
    warm = "" if head_steps is None else f", warm start of {head_steps}"
    shipped = "policy that ships, " if policy == SHIPPED_POLICY else ""
    return f"{shipped}{engine}{warm}"


@dataclass(frozen=True, kw_only=True)
class RateTrial:
    """One flight of the search for the highest action rate."""

    action_hz: float
    missed_fraction: float
    vision_hz: float | None


@dataclass(frozen=True, kw_only=True)
class TopRate:
    """The highest action rate with few enough missed slots."""

    label: str
    """Engine and kind of solve."""
    action_hz: float | None
    """None: not even the lowest rate tried."""
    trials: tuple[RateTrial, ...]


@dataclass(frozen=True, kw_only=True)
class LinkClient:
    """What a client of the link test can say of itself."""

    state_to_wire_ms: Percentiles | None
    work_ms: Percentiles | None


@dataclass(frozen=True, kw_only=True)
class Link:
    """Attitude out of the vehicle -> sticks back in, by one client; medians over the repeats."""

    client: str
    output: str
    """The MAVLink message that carries the sticks, in words."""
    sent: int
    answered: int
    round_trip_ms: Percentiles
    """On the vehicle's clock: its send to the arrival that the kernel stamped."""
    state_to_wire_ms: Percentiles | None
    """Inside the client: kernel's arrival stamp to the send; None = it cannot tell."""
    work_ms: Percentiles | None
    """Inside the client: waking for the tick to the send. The rest of the round trip is waiting
    for the slot of its clock, and the kernel."""


@dataclass(frozen=True, kw_only=True)
class BenchResult:
    """One run."""

    machine: Machine
    quick: bool
    kernels: tuple[Kernel, ...]
    rooflines: tuple[Roofline, ...]
    flights: tuple[Flight, ...]
    top_rates: tuple[TopRate, ...]
    links: tuple[Link, ...]
    notes: tuple[str, ...]
    """What was left out, and why."""


def to_json(result: BenchResult | Flight | LinkClient) -> str:
    """Keys in the order of the dataclasses; null = not measured."""
    return json.dumps(asdict(result), indent=2, allow_nan=False) + "\n"


def flight_from_json(text: str, vehicle: Vehicle | None) -> Flight:
    """What a runner's process wrote, joined with what the vehicle saw."""
    document = _with_percentiles(json.loads(text))
    return Flight(**(document | {"vehicle": vehicle}))


def link_client_from_json(text: str) -> LinkClient:
    """What a client of the link test wrote."""
    return LinkClient(**_with_percentiles(json.loads(text)))


def _with_percentiles(document: Mapping[str, Any]) -> dict[str, Any]:
    return {
        key: Percentiles(**value) if key.endswith("_ms") and isinstance(value, dict) else value
        for key, value in document.items()
    }


def median_percentiles(found: Iterable[Percentiles | None]) -> Percentiles | None:
    """Each percentile's median over the repeats that have it; None if none has."""
    present = [one for one in found if one is not None]
    if not present:
        return None
    names = [field.name for field in fields(Percentiles)]
    return Percentiles(
        **{name: round(median(getattr(one, name) for one in present), 3) for name in names}
    )
