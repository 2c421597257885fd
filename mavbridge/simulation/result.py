"""The result of an episode: one flight of one course, simulated or on the wall clock."""

import math
from dataclasses import dataclass
from typing import Literal

from mavbridge.core.clock import NS_PER_S
from mavbridge.core.records import Event, Sticks, Tick

Outcome = Literal["finished", "crashed", "disarmed", "timed out"]
"""All gates passed; hit the ground or a gate; motors stopped in flight; none of these in time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeResult:
    """One flight of one course; times count from the policy's first action."""

    course_seed: int
    seed: int
    outcome: Outcome
    gates_total: int
    gate_times_s: tuple[float, ...]
    flown_s: float
    """Until the end of the episode: one second after the last gate, the crash, or the limit."""
    distance_m: float
    """Along the path, to the end of the episode."""
    stick_rate_per_s: float | None
    """Mean over the four sticks of |change| per second, as sent; full deflection is 1. None = the
    policy never had the sticks for two actions in a row."""

    @property
    def has_finished(self) -> bool:
        """All gates were passed in order, without a crash."""
        return self.outcome == "finished"

    @property
    def gates_passed(self) -> int:
        """Number of gates passed in order."""
        return len(self.gate_times_s)

    @property
    def mean_speed_mps(self) -> float:
        """Over the whole flight, take-off included."""
        return self.distance_m / self.flown_s if self.flown_s > 0 else 0.0

    @property
    def course_s(self) -> float | None:
        """First action to last gate; None unless finished."""
        return self.gate_times_s[-1] if self.has_finished and self.gate_times_s else None


class StickMeter:
    """A ``TickSink`` that measures how much the policy moves the sticks."""

    def __init__(self) -> None:
        self.engaged_ns: int | None = None
        self._last: tuple[int, Sticks] | None = None
        self._travel = 0.0
        self._moved_ns = 0

    def emit(self, event: Event) -> None:
        """Add the change since the tick before."""
        if not isinstance(event, Tick):
            return
        if event.trace is None or event.sent is None:
            self._last = None
            return
        if self.engaged_ns is None:
            self.engaged_ns = event.woke_ns
        last, self._last = self._last, (event.sent_ns, event.sent)
        if last is not None:
            self._moved_ns += event.sent_ns - last[0]
            self._travel += math.fsum(
                abs(now - before) for now, before in zip(event.sent, last[1], strict=True)
            )

    @property
    def rate_per_s(self) -> float | None:
        """Mean over the sticks of |change| per second; None before two actions in a row."""
        if not self._moved_ns:
            return None
        return self._travel / len(Sticks._fields) / (self._moved_ns / NS_PER_S)
