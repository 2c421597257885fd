"""Signals that end a flight in order, however often they are sent, and the end of the process."""

import os
import queue
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import NoReturn

from mavbridge.core.clock import NS_PER_MS, Clock, MonotonicClock
from mavbridge.core.workers import Worker

INTERRUPTED = 130
"""What shells report of a program ended by Ctrl-C."""
ONE_REQUEST_NS = 250 * NS_PER_MS
"""Signals closer than this are one request. A closing terminal sends SIGHUP more than once, and a
program that runs this one passes on a Ctrl-C which the terminal has sent to both."""
LAST_WORDS_S = 1.0
"""Time for a reader of the console to take the last words, before the process ends without."""


class StopRequest:
    """Set from a signal handler; waited for by the main thread.

    Not a ``threading.Event``: a handler runs between any two instructions of the main thread, also
    inside ``Event.wait`` or an earlier handler's ``Event.set``, and then waits for the lock that
    its own thread holds. ``SimpleQueue.put`` is reentrant (CPython documents it for this use).
    """

    def __init__(self, clock: Clock | None = None) -> None:
        self._clock = MonotonicClock() if clock is None else clock
        self._wake: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._newest_ns: int | None = None
        self.signal_number: int | None = None
        """The first signal that requested it."""
        self.requests = 0
        """Times it was set; signals within ``ONE_REQUEST_NS`` of one another count once."""

    def set(self) -> None:
        """Request the stop, once more if it was requested before."""
        now_ns, newest_ns = self._clock.now_ns(), self._newest_ns
        # From here to the count nothing is called: another handler can interrupt only calls.
        self._newest_ns = now_ns
        if newest_ns is None or now_ns - newest_ns >= ONE_REQUEST_NS:
            self.requests += 1
        self._wake.put(None)

    def is_set(self) -> bool:
        """Return whether the stop was requested."""
        return self.requests > 0

    def wait(self, timeout_s: float, *, requests: int = 1) -> bool:
        """Wait for so many requests; returns whether they have come.

        It may return before ``timeout_s`` without them: once for each earlier signal.
        """
        if self.requests < requests:
            with suppress(queue.Empty):
                self._wake.get(timeout=timeout_s)
        return self.requests >= requests


@contextmanager
def stop_on_signals() -> Iterator[StopRequest]:
    """Let SIGINT, SIGTERM and SIGHUP request the stop; restores the old handlers afterwards."""
    stop = StopRequest()

    def on_signal(number: int, _frame: FrameType | None) -> None:
        stop.signal_number = stop.signal_number or number
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


def interrupt_once(clock: Clock | None = None) -> None:
    """Let the first Ctrl-C raise KeyboardInterrupt, and a later one end the process at once.

    A second KeyboardInterrupt would cut the clean-up of the first short with a traceback. The guard
    notices the end like any other death of this process.
    """
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        return  # ignored, as shells start programs in the background
    clock = MonotonicClock() if clock is None else clock
    first_ns: int | None = None

    def interrupt(*_: object) -> None:
        nonlocal first_ns
        now_ns = clock.now_ns()
        if first_ns is None:
            first_ns = now_ns
            raise KeyboardInterrupt
        if now_ns - first_ns >= ONE_REQUEST_NS:
            os._exit(INTERRUPTED)

    signal.signal(signal.SIGINT, interrupt)


def end_process(status: int, say: Callable[[], None] | None = None) -> NoReturn:
    """End the process with ``status``, after ``say`` has printed, whoever reads the console or not.

    An ordinary exit flushes standard output and error, and so waits for ever where another thread
    is asleep in a write to them or their reader has stalled. Whether they can be flushed is tried
    for ``LAST_WORDS_S``; if not, the process ends at once, and exit handlers do not run.
    """

    def finish(_stop: threading.Event) -> None:
        if say is not None:
            say()
        for stream in filter(None, (sys.stdout, sys.stderr)):
            stream.flush()

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a second Ctrl-C would cut the last words short
    last_words = Worker("mavbridge-last-words", finish)
    last_words.start()
    if not last_words.ends_within(LAST_WORDS_S):
        os._exit(status)
    sys.exit(status)
