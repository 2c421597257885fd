"""Results of a benchmark as frozen values, and their JSON."""

import json
import os
import platform
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, is_dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar, get_args, get_type_hints

from mavbridge.config.policy import PolicyConfig
from mavbridge.core.records import Percentiles

OURS, BASELINE = "mavbridge", "baseline"
"""Runners of a flight."""
T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class Machine:
    """The computer of a run."""

    cpu: str
    cores: int
    """Usable by this process."""
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
    """Kind of solve, as ``solves_of`` names it."""
    engine: str
    asked_action_hz: float
    asked_vision_hz: float
    duration_s: float
    action_hz: float | None
    vision_hz: float | None
    missed_slots: int
    """Ticks of the asked grid that did not happen."""
    period_ms: Percentiles | None
    predict_ms: Percentiles | None
    encode_ms: Percentiles | None
    feature_age_ms: Percentiles | None
    """From exposure to send."""
    state_to_wire_ms: Percentiles | None
    """From an attitude's arrival at this computer to the send of the first sticks made from it."""
    cpu_cores: float
    """Processor time of the bridge's process over elapsed time."""
    stolen_ms: float | None
    """Processor time that the hypervisor gave to others meanwhile."""
    missed_by_cause: Mapping[str, int] | None
    """Missed slots by ``missed_slots.Cause``."""
    vehicle_gap_ms: Mapping[str, float] | None = None
    """p50, p99 and max between stick messages, as the vehicle saw them arrive."""

    @property
    def label(self) -> str:
        """Runner, policy, kind of solve and engine."""
        return f"{self.runner}, {self.policy}, {self.solves}, {self.engine}"

    @property
    def missed_fraction(self) -> float:
        """Missed over asked slots."""
        asked = self.asked_action_hz * self.duration_s
        return self.missed_slots / asked if asked > 0 else 1.0


@dataclass(frozen=True, kw_only=True)
class ClientTiming:
    """Figures that a client of the link test measures itself; None = not measured."""

    state_to_wire_ms: Percentiles | None = None
    """From the kernel's arrival stamp of an attitude to the send."""
    work_ms: Percentiles | None = None
    """From waking for the tick to the send."""


@dataclass(frozen=True, kw_only=True)
class LinkLatency:
    """The time from an attitude's send by the vehicle to the arrival of its sticks."""

    client: str
    sent: int
    answered: int
    round_trip_ms: Percentiles
    """On the vehicle's clock: its send to the arrival that its kernel stamped."""
    timing: ClientTiming


@dataclass(frozen=True, kw_only=True)
class BenchResult:
    """One run."""

    machine: Machine
    quick: bool
    engines: tuple[EngineTiming, ...]
    flights: tuple[Flight, ...]
    links: tuple[LinkLatency, ...]
    notes: tuple[str, ...]
    """Parts that were left out, with the reasons."""


def name_of(policy: PolicyConfig) -> str:
    """The checkpoint's name, or that of the policy."""
    return policy.policy if policy.checkpoint is None else policy.checkpoint.stem


def solves_of(policy: PolicyConfig) -> str:
    """The kind of solve that makes a policy's chunks, for tables."""
    if not policy.dual_rate:
        return "single rate"
    return "full solves" if policy.head_steps is None else f"warm start of {policy.head_steps}"


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


def from_json(kind: type[T], text: str) -> T:
    """Inverse of ``to_json`` for a dataclass whose nested fields are dataclasses or None."""
    return _build(kind, json.loads(text))


def _build(kind: type[T], document: Mapping[str, Any]) -> T:
    hints = get_type_hints(kind)

    def value_of(name: str, value: Any) -> Any:
        kinds = get_args(hints[name]) or (hints[name],)
        nested: Any = next((one for one in kinds if is_dataclass(one)), None)
        return _build(nested, value) if nested and isinstance(value, dict) else value

    return kind(**{name: value_of(name, value) for name, value in document.items()})
