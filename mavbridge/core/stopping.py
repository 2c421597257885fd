"""Threads that can be told to stop, stop signals of a flight, and a bounded end of the process."""

import math
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
from mavbridge.core.errors import ExitCode, MavbridgeError

INTERRUPTED = 130
"""Exit status that shells report after Ctrl-C."""
ONE_REQUEST_NS = 250 * NS_PER_MS
"""Signals closer together are one request. A closing terminal sends SIGHUP more than once, and a
parent program may pass on a Ctrl-C that the terminal has sent to both."""
FLUSH_S = 1.0
"""Longest wait for the console to take the last output before the process exits."""
EXIT_S = 5.0
"""Longest wait for exit handlers, and for threads and pools that a policy has left."""


class HungError(MavbridgeError):
    """A thread that did not stop when it was told to."""

    exit_code = ExitCode.FAULT


class Worker:
    """A thread that keeps an exception of its target and raises it again in ``join``."""

    def __init__(self, name: str, target: Callable[[threading.Event], None]) -> None:
        self._target = target
        self._stop = threading.Event()
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def _run(self) -> None:
        try:
            self._target(self._stop)
        except BaseException as failure:  # noqa: BLE001 - raised again by join
            self._failure = failure

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    @property
    def is_alive(self) -> bool:
        """Return whether the thread is running."""
        return self._thread.is_alive()

    def ends_within(self, timeout_s: float) -> bool:
        """Wait without requesting a stop; returns whether the thread has ended."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def join(self, timeout_s: float) -> None:
        """Request the stop, wait for the thread, and raise what it raised, or HungError."""
        self._stop.set()
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            raise HungError(f"thread {self._thread.name} did not stop within {timeout_s:g} s")
        if self._failure is not None:
            raise self._failure


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
        """First signal that requested the stop."""
        self.requests = 0
        """Number of requests; signals within ``ONE_REQUEST_NS`` of one another count once."""

    def set(self) -> None:
        """Request the stop, or request it once more."""
        now_ns, newest_ns = self._clock.now_ns(), self._newest_ns
        # From here to the count nothing is called: another handler can interrupt only calls.
        self._newest_ns = now_ns
        if newest_ns is None or now_ns - newest_ns >= ONE_REQUEST_NS:
            self.requests += 1
        self._wake.put(None)

    def is_set(self) -> bool:
        """Return True if a stop was requested."""
        return self.requests > 0

    def wait(self, timeout_s: float) -> bool:
        """Wait for the request; return whether it has come."""
        if not self.is_set():
            with suppress(queue.Empty):
                self._wake.get(timeout=timeout_s)
        return self.is_set()


def stop_signals() -> list[int]:
    """Return the signals that end a command: SIGTERM, and SIGINT and SIGHUP where not ignored.

    ``nohup`` ignores SIGHUP, and shells ignore SIGINT for programs that they start in the
    background.
    """
    # SIGHUP: the terminal, or the connection to this computer, is gone.
    both = (signal.SIGINT, signal.SIGHUP)
    handled = [one for one in both if signal.getsignal(one) is not signal.SIG_IGN]
    return [signal.SIGTERM, *handled]


def _on_signal(stop: StopRequest, noted: float) -> Callable[[int, FrameType | None], None]:
    """Return a handler that notes the first ``noted`` requests in ``stop``; the next one raises
    KeyboardInterrupt, and the one after exits at once."""

    def handle(number: int, _frame: FrameType | None) -> None:
        stop.signal_number = stop.signal_number or number
        before = stop.requests
        stop.set()
        if stop.requests == before or before < noted:
            return
        if before == noted:
            raise KeyboardInterrupt
        os._exit(128 + number)

    return handle


@contextmanager
def stop_on_signals(*, is_bounded: bool = False) -> Iterator[StopRequest]:
    """Context manager: the signals of ``stop_signals`` request the stop.

    The second request raises KeyboardInterrupt and the third exits at once, because a policy may
    hang, unless the block ``is_bounded``: it ends by deadlines of its own.
    """
    stop = StopRequest()
    handle = _on_signal(stop, math.inf if is_bounded else 1)
    previous = {number: signal.signal(number, handle) for number in stop_signals()}
    try:
        yield stop
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def interrupt_once(clock: Clock | None = None) -> None:
    """Let the first Ctrl-C raise KeyboardInterrupt, and a later one exit at once.

    A second KeyboardInterrupt would interrupt the clean-up of the first with a traceback. The guard
    handles the exit like any other death of this process.
    """
    # Ignored, as shells start programs in the background, it stays so.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _on_signal(StopRequest(clock), 0))


def end_process(
    status: int, say: Callable[[], None] | None = None, *, must_exit: bool = True
) -> NoReturn:
    """Exit with ``status`` after calling ``say``, without blocking on the console.

    An ordinary exit flushes standard output and error, and blocks for ever if another thread sleeps
    in a write to them or their reader has stalled. Here the flush is tried for ``FLUSH_S``; if
    it does not succeed, the process exits at once, without exit handlers. An ordinary exit would
    also wait for threads of a policy: with ``must_exit``, the process ends after ``EXIT_S``.
    """

    def finish(_stop: threading.Event) -> None:
        if say is not None:
            say()
        for stream in filter(None, (sys.stdout, sys.stderr)):
            stream.flush()

    def end_late(stop: threading.Event) -> None:
        stop.wait(EXIT_S)
        os._exit(status)

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a second Ctrl-C would cut the output short
    flush = Worker("mavbridge-flush", finish)
    flush.start()
    if not flush.ends_within(FLUSH_S):
        os._exit(status)
    if must_exit:
        Worker("mavbridge-late-end", end_late).start()
    sys.exit(status)
