"""Host clock in integer nanoseconds, shared by all processes, and stop signals."""

import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager

NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000
NS_PER_US = 1_000


class Clock:
    """CLOCK_MONOTONIC: never set back, one origin for all processes. Tests inject another one."""

    def now_ns(self) -> int:
        return time.monotonic_ns()

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Sleep until ``deadline_ns``; return at once if it has passed."""
        while (left_ns := deadline_ns - time.monotonic_ns()) > 0:
            time.sleep(left_ns / NS_PER_S)


def wall_ns() -> int:
    """Return Unix time, for protocols that need it."""
    return time.time_ns()


def next_slot_ns(due_ns: int, period_ns: int, now_ns: int) -> int:
    """Return the slot of a grid after ``due_ns``; slots that ``now_ns`` has reached are skipped."""
    return due_ns + period_ns * (1 + max(0, now_ns - due_ns) // period_ns)


def monotonic_from_wall_ns(wall_ns: int) -> int:
    """Convert a recent CLOCK_REALTIME stamp, for example the kernel's stamp of a datagram."""
    return time.monotonic_ns() - (time.time_ns() - wall_ns)


class StopRequest:
    """Stop flag that a signal handler may set.

    Not a ``threading.Event``: a second signal's handler would wait for the first one's lock.
    """

    _is_set = False

    def set(self) -> None:
        self._is_set = True

    def is_set(self) -> bool:
        return self._is_set


@contextmanager
def stop_on_signal() -> Iterator[StopRequest]:
    """Context manager: SIGINT and SIGTERM set the flag; the old handlers return at the end.

    Ignored ones stay ignored: shells ignore SIGINT for programs that they start in the background.
    """
    stop = StopRequest()
    signals = (signal.SIGINT, signal.SIGTERM)
    handled = [one for one in signals if signal.getsignal(one) is not signal.SIG_IGN]
    previous = {one: signal.signal(one, lambda *_: stop.set()) for one in handled}
    try:
        yield stop
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
