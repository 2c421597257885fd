"""Console output that a reader who does not read cannot hold up."""

import io
import os
import select
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TextIO, cast

from rich.console import Console

POLL_S = 0.05
"""Interval at which a stalled write looks whether it was given up."""
WRITE_BYTES = 512
"""Handed to the kernel at once: a pipe that is ready takes it whole (POSIX: _POSIX_PIPE_BUF)."""
MAX_LINE = 2000
"""Characters of text without a line end that are kept; more counts as a line."""


class PatientOutput(io.TextIOBase):
    """A text stream that writes only where the kernel takes it at once, and that can be given up.

    ``sys.stderr`` will not do for a thread whose reader may stall: the thread would sleep in
    ``write`` with the stream's lock held, and at its end the interpreter waits for that lock
    (measured on CPython 3.11, with a full pipe and with a terminal stopped by Ctrl-S).
    For one thread; ``give_up`` is for any.
    """

    encoding = "utf-8"

    def __init__(self, stream: TextIO) -> None:
        """Write to the file behind ``stream``; raises OSError if there is none."""
        super().__init__()
        self._fd = stream.fileno()
        self._waiting = b""
        self._is_given_up = False
        self.encoding = stream.encoding or "utf-8"

    def fileno(self) -> int:
        """Return the file descriptor."""
        return self._fd

    def isatty(self) -> bool:
        """Return whether this is a terminal."""
        return os.isatty(self._fd)

    def writable(self) -> bool:
        """Return True."""
        return True

    def give_up(self) -> None:
        """Drop what is waiting and all that comes; ends a ``flush`` in another thread."""
        self._is_given_up = True

    def write(self, text: str) -> int:
        """Keep the text for ``flush``."""
        self._waiting += text.encode(self.encoding, "backslashreplace")
        return len(text)

    def flush(self) -> None:
        """Write all, however long the reader takes, unless it is given up or the reader is gone."""
        while self._waiting and not self._is_given_up:
            try:
                if select.select([], [self._fd], [], POLL_S)[1]:
                    written = os.write(self._fd, self._waiting[:WRITE_BYTES])
                    self._waiting = self._waiting[written:]
            except BlockingIOError:
                continue
            except OSError:  # the pipe is closed, the terminal has hung up
                self._is_given_up = True
        self._waiting = b"" if self._is_given_up else self._waiting


def flight_console() -> Console:
    """A console on standard error for ``FlightScreen``, which alone uses it during a flight."""
    try:
        return Console(file=cast(TextIO, PatientOutput(sys.stderr)), emoji=False)
    except (OSError, AttributeError):  # standard error is closed, or replaced by a mere buffer
        return Console(stderr=True, emoji=False)


class _Lines(io.TextIOBase):
    """A text stream that passes on whole lines instead of writing them."""

    def __init__(self, show: Callable[[str], None], replaced: TextIO) -> None:
        super().__init__()
        self._show = show
        self._replaced = replaced
        self._partial = ""

    def fileno(self) -> int:
        return self._replaced.fileno()

    def writable(self) -> bool:
        return True

    def write(self, text: str) -> int:
        *lines, partial = (self._partial + text).replace("\r", "\n").split("\n")
        if len(partial) > MAX_LINE:
            lines, partial = [*lines, partial], ""
        self._partial = partial
        for line in filter(None, lines):
            self._show(line)
        return len(text)


@contextmanager
def stray_lines_shown(show: Callable[[str], None]) -> Iterator[None]:
    """Give ``show`` each line that anybody prints, so that no thread waits for the console.

    Standard error (logging, warnings, tracebacks of threads), and standard output if it is a
    terminal, and so the same console.
    """
    old_out, old_err = sys.stdout, sys.stderr
    is_console = old_out is not None and not old_out.closed and old_out.isatty()
    sys.stderr = _Lines(show, old_err)
    if is_console:
        sys.stdout = _Lines(show, old_out)
    try:
        yield
    finally:
        sys.stdout, sys.stderr = old_out, old_err
