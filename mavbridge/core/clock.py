"""The one clock, monotonic integer nanoseconds and injected everywhere, and the pacers' slots."""

import time
from dataclasses import dataclass
from typing import Protocol

NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000


def period_ns(rate_hz: float) -> int:
    """Period of a rate in integer nanoseconds."""
    return round(NS_PER_S / rate_hz)


def wall_offset_ns(clock: "Clock") -> int:
    """Return Unix time minus the clock, to label moments; take it once, because wall time steps."""
    return time.time_ns() - clock.now_ns()


class Clock(Protocol):
    """Time source of every loop; tests inject a virtual one."""

    def now_ns(self) -> int:
        """Nanoseconds on a monotonic clock with an arbitrary origin."""

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Return at or after ``deadline_ns``; at once if it has passed."""


class MonotonicClock:
    """CLOCK_MONOTONIC: shared by all processes of one machine, never steps."""

    def now_ns(self) -> int:
        """Nanoseconds of CLOCK_MONOTONIC."""
        return time.monotonic_ns()

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Sleep to the deadline; a sleep that the kernel ends early is continued."""
        while (left_ns := deadline_ns - time.monotonic_ns()) > 0:
            time.sleep(left_ns / NS_PER_S)


@dataclass(frozen=True, slots=True, kw_only=True)
class Slot:
    """One slot: a point of the pacer's grid at which one command is due, and when it was met."""

    index: int
    due_ns: int
    woke_ns: int
    missed: int
    """Slots skipped since the previous one: their commands were never sent."""


class Pacer(Protocol):
    """Says when the next tick is."""

    def wait(self) -> Slot:
        """Sleep until the next tick."""


class GridPacer:
    """An absolute grid of slots, ``origin + index * period``.

    A slot missed by more than a quarter of the period is skipped and counted, never made up for:
    two commands are never closer than 3/4 of a period, and the phase survives any stall. A slot
    missed by less fires at once, since a command 1 ms late beats one 10 ms late.
    """

    def __init__(self, clock: Clock, *, period_ns: int) -> None:
        if period_ns <= 0:
            raise ValueError(f"period_ns must be positive, got {period_ns}")
        self._clock = clock
        self._period_ns = period_ns
        self._tolerance_ns = period_ns // 4
        self._origin_ns: int | None = None
        self._index = -1

    def wait(self) -> Slot:
        """Sleep until the next slot that can still be met."""
        now_ns = self._clock.now_ns()
        if self._origin_ns is None:
            self._origin_ns = now_ns
        first = self._index + 1
        earliest_ns = now_ns - self._tolerance_ns - self._origin_ns
        self._index = max(first, -(-earliest_ns // self._period_ns))
        due_ns = self._origin_ns + self._index * self._period_ns
        self._clock.sleep_until_ns(due_ns)
        return Slot(
            index=self._index,
            due_ns=due_ns,
            woke_ns=self._clock.now_ns(),
            missed=self._index - first,
        )
