"""The simulator's time source: CLOCK_MONOTONIC as integer nanoseconds, shared by all processes."""

import time
from typing import Protocol

NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000


class Clock(Protocol):
    """What the real-time loop needs of time; tests inject a stepped one."""

    def now_ns(self) -> int:
        """Nanoseconds on a monotonic clock with an arbitrary origin."""
        ...

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Return at or after ``deadline_ns``; at once if it has passed."""
        ...


class MonotonicClock:
    """Never steps; the same origin in every process of one machine."""

    def now_ns(self) -> int:
        """Nanoseconds of CLOCK_MONOTONIC."""
        return time.monotonic_ns()

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Return at or after ``deadline_ns``; at once if it has passed."""
        while (left_ns := deadline_ns - time.monotonic_ns()) > 0:
            time.sleep(left_ns / NS_PER_S)


def monotonic_from_wall_ns(wall_ns: int) -> int:
    """A recent CLOCK_REALTIME stamp (the kernel stamps datagrams with it) on CLOCK_MONOTONIC."""
    return time.monotonic_ns() - (time.time_ns() - wall_ns)
