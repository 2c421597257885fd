"""Signals that end a flight in order, however often they are sent."""

import queue
import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType

INTERRUPTED = 130
"""What shells report of a program ended by Ctrl-C."""


class StopRequest:
    """Set once, from a signal handler; waited for by the main thread.

    Not a ``threading.Event``: a handler runs between any two instructions of the main thread, also
    inside ``Event.wait`` or an earlier handler's ``Event.set``, and then waits for the lock that
    its own thread holds. ``SimpleQueue.put`` is reentrant (CPython documents it for this use).
    """

    def __init__(self) -> None:
        self._wake: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._is_set = False

    def set(self) -> None:
        """Request the stop."""
        self._is_set = True
        self._wake.put(None)

    def is_set(self) -> bool:
        """Return whether the stop was requested."""
        return self._is_set

    def wait(self, timeout_s: float) -> bool:
        """Wait for the request, at most ``timeout_s``; returns whether it has come."""
        if not self._is_set:
            with suppress(queue.Empty):
                self._wake.get(timeout=timeout_s)
        return self._is_set


@contextmanager
def stop_on_signals() -> Iterator[StopRequest]:
    """Let SIGINT, SIGTERM and SIGHUP request the stop; restores the old handlers afterwards."""
    stop = StopRequest()

    def on_signal(_number: int, _frame: FrameType | None) -> None:
        stop.set()

    # SIGHUP: the terminal, or the connection to this computer, is gone.
    names = ("SIGINT", "SIGTERM", "SIGHUP")
    numbers = [getattr(signal, name) for name in names if hasattr(signal, name)]
    previous = {number: signal.signal(number, on_signal) for number in numbers}
    try:
        yield stop
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
