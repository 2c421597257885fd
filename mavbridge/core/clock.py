"""The one clock: monotonic integer nanoseconds, injected everywhere."""

import time
from typing import Protocol

NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000


def period_ns(rate_hz: float) -> int:
    """Return the period of a rate [ns]."""
    return round(NS_PER_S / rate_hz)


def wall_offset_ns(clock: "Clock") -> int:
    """Return Unix time minus clock time [ns], to label moments. Call once: wall time may step."""
    return time.time_ns() - clock.now_ns()


class Clock(Protocol):
    """Time source of every loop. Tests inject a virtual one."""

    def now_ns(self) -> int:
        """Return the time [ns]; monotonic, with an arbitrary origin."""

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Return at or after ``deadline_ns``, immediately if it has passed."""


class MonotonicClock:
    """CLOCK_MONOTONIC: shared by all processes of one machine, never steps."""

    def now_ns(self) -> int:
        """Return CLOCK_MONOTONIC [ns]."""
        return time.monotonic_ns()

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Sleep until the deadline, also if the kernel ends a sleep early."""
        while (left_ns := deadline_ns - time.monotonic_ns()) > 0:
            time.sleep(left_ns / NS_PER_S)
