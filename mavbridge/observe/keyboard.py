"""Single-key input from the terminal during a flight."""

import os
import select
import signal
import sys
import termios
import threading
import tty
from collections.abc import Callable, Sequence
from contextlib import suppress

from mavbridge.core.stopping import Worker

ENGAGE_KEY, RELEASE_KEY = "e", "q"
FLIGHT_KEYS = (RELEASE_KEY, ENGAGE_KEY)
KEYS_HINT = "e engages, q releases"
POLL_S = 0.1
_LOCAL_MODES = 3
"""Index of the local modes in the list that ``termios.tcgetattr`` returns."""


def ignore_job_control() -> None:
    """Prevent terminal access by the calling thread from stopping the process.

    A background process is stopped by SIGTTIN when it reads the terminal, and by SIGTTOU when it
    changes it or (after ``stty tostop``) writes it, unless the calling thread blocks the signal.
    """
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTTIN, signal.SIGTTOU})


class Keyboard:
    """Passes each key of ``keys`` to ``on_key``, in lower case, from a separate thread.

    While this process is in the foreground, the terminal delivers keys at once and without echo;
    Ctrl-C remains a signal. Without a terminal this is a no-op. ``on_key`` must not block.
    """

    def __init__(
        self,
        on_key: Callable[[str], None],
        *,
        keys: Sequence[str] = FLIGHT_KEYS,
        fd: int | None = None,
    ) -> None:
        """Read ``fd``; default: standard input.

        The first of ``keys`` also counts among several keys typed at once; the others only alone.
        """
        self._on_key = on_key
        self._urgent_key, *self._keys = keys
        self._fd = _standard_input() if fd is None else fd
        self._old_modes: list[int | list[bytes | int]] | None = None
        self._worker: Worker | None = None

    def start(self) -> bool:
        """Start listening; return True if there is a terminal."""
        if self._fd is None or not os.isatty(self._fd):
            return False
        fd = self._fd
        self._worker = Worker("mavbridge-keyboard", lambda stop: self._run(fd, stop))
        self._worker.start()
        return True

    def stop(self, timeout_s: float) -> None:
        """Stop, and restore the terminal. Can be called at any time and more than once.

        Raises:
            HungError: ``on_key`` has not returned within the timeout.
        """
        worker, self._worker = self._worker, None
        if worker is not None:
            worker.join(timeout_s)

    def _run(self, fd: int, stop: threading.Event) -> None:
        ignore_job_control()
        try:
            while not stop.is_set():
                if not _is_foreground(fd):
                    stop.wait(POLL_S)  # the shell has restored the terminal's own modes
                    continue
                self._take(fd)
                if select.select([fd], [], [], POLL_S)[0] and not self._read(fd):
                    return
        except (OSError, termios.error):
            return  # the terminal is gone
        finally:
            with suppress(OSError, termios.error):  # the terminal may be gone
                if self._old_modes is not None and _is_foreground(fd):
                    termios.tcsetattr(fd, termios.TCSANOW, self._old_modes)

    def _take(self, fd: int) -> None:
        """Have keys delivered singly, without echo: at the start, and after Ctrl-Z and fg."""
        modes = termios.tcgetattr(fd)
        if modes[_LOCAL_MODES] & (termios.ICANON | termios.ECHO):
            self._old_modes = modes
            termios.tcflush(fd, termios.TCIFLUSH)  # keys typed before the flight must not engage it
            # TCSANOW: the other modes wait until a stopped terminal has shown all output.
            tty.setcbreak(fd, termios.TCSANOW)

    def _read(self, fd: int) -> bool:
        """Pass on the typed keys; return False at the end of the input."""
        typed = os.read(fd, 1024).decode(errors="replace").lower()
        # Several keys at once are a paste or a function key's sequence, and must not engage.
        if self._urgent_key in typed and not typed.startswith("\x1b"):
            self._on_key(self._urgent_key)
        elif len(set(typed)) == 1 and typed[0] in self._keys:
            self._on_key(typed[0])
        return bool(typed)


def _standard_input() -> int | None:
    try:
        return sys.stdin.fileno()
    except (OSError, ValueError, AttributeError):  # closed, replaced by a buffer, or absent
        return None


def _is_foreground(fd: int) -> bool:
    """True if the terminal's input is ours, or if it is not our controlling terminal."""
    try:
        return os.tcgetpgrp(fd) == os.getpgrp()
    except OSError:  # not our controlling terminal, so no other jobs compete for it
        return True
