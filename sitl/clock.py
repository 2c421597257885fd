"""The simulator's time source: CLOCK_MONOTONIC as integer nanoseconds, shared by all processes."""

import time

NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000


class Clock:
    """CLOCK_MONOTONIC: never set back, one origin for all processes; tests inject a stepped one."""

    def now_ns(self) -> int:
        """Nanoseconds since an arbitrary origin."""
        return time.monotonic_ns()

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Return at or after ``deadline_ns``; at once if it has passed."""
        while (left_ns := deadline_ns - time.monotonic_ns()) > 0:
            time.sleep(left_ns / NS_PER_S)


def monotonic_from_wall_ns(wall_ns: int) -> int:
    """Convert a recent CLOCK_REALTIME stamp, such as the kernel's of a datagram."""
    return time.monotonic_ns() - (time.time_ns() - wall_ns)
