"""Signals that end the program in order, however many of them come."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager


class StopRequest:
    """A flag that a signal handler may set.

    Not a ``threading.Event``: a second signal would wait for the lock that the first one's handler
    holds.
    """

    def __init__(self) -> None:
        self._is_set = False

    def set(self) -> None:
        """Request the stop."""
        self._is_set = True

    def is_set(self) -> bool:
        """True once a stop was requested."""
        return self._is_set


@contextmanager
def stop_on_signal() -> Iterator[StopRequest]:
    """Let SIGINT and SIGTERM request the stop; the old handlers come back afterwards."""
    stop = StopRequest()
    signals = (signal.SIGINT, signal.SIGTERM)
    previous = [signal.signal(number, lambda *_: stop.set()) for number in signals]
    try:
        yield stop
    finally:
        for number, handler in zip(signals, previous, strict=True):
            signal.signal(number, handler)
