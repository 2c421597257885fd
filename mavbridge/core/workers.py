"""Named threads whose exceptions are not lost."""

import threading
from collections.abc import Callable

from mavbridge.core.errors import ExitCode, MavbridgeError


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
