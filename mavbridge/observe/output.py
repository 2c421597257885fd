"""Console output that a stalled reader cannot block and a lost one cannot fail."""

import errno
import io
import os
import select
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TextIO, cast

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment

from mavbridge.core.provenance import printable

POLL_S = 0.05
"""Interval at which a stalled write checks whether it was given up."""
WRITE_BYTES = 512
"""Bytes handed to the kernel per write: a ready pipe takes them all (POSIX: _POSIX_PIPE_BUF)."""
MAX_LINE = 2000
"""Kept characters of an unfinished line; longer text counts as a line."""


class PatientOutput(io.TextIOBase):
    """Text stream that writes only if the kernel takes the data at once, and that can be given up.

    ``sys.stderr`` does not suit a thread whose reader can stall: the thread would sleep in
    ``write`` holding the stream's lock, and the interpreter waits for that lock when it exits
    (measured on CPython 3.11, with a full pipe and with a terminal stopped by Ctrl-S). For one
    thread; ``give_up`` can be called from any.
    """

    encoding = "utf-8"

    def __init__(self, stream: TextIO) -> None:
        """Write to the file behind ``stream``; raise OSError if there is none."""
        super().__init__()
        self._waiting = b""  # before anything fails: Python 3.13 reports errors of closing, too
        self._is_given_up = False
        self._fd = stream.fileno()
        self.encoding = stream.encoding or "utf-8"

    def fileno(self) -> int:
        """Return the file descriptor."""
        return self._fd

    def isatty(self) -> bool:
        """True if the file is a terminal."""
        return os.isatty(self._fd)

    def give_up(self) -> None:
        """Drop all pending and future text; ends a ``flush`` in another thread."""
        self._is_given_up = True

    def write(self, text: str) -> int:
        """Keep the text for ``flush``."""
        self._waiting += text.encode(self.encoding, "backslashreplace")
        return len(text)

    def flush(self) -> None:
        """Write all text at the reader's pace, unless it is given up or the reader is gone."""
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


class SafeConsole(Console):
    """Console whose texts cannot steer the terminal; Rich's own styles and bars still can."""

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterator[Segment]:
        """Render with ``printable`` texts."""
        for part in super().render(renderable, options):
            yield part if part.control else part._replace(text=printable(part.text))


def patient_console(*, stderr: bool = True) -> Console:
    """Return a console for one thread, the only one that a stalled reader holds up."""
    try:
        stream = PatientOutput(sys.stderr if stderr else sys.stdout)
        return SafeConsole(file=cast(TextIO, stream), emoji=False)
    except (OSError, AttributeError):  # the stream is closed, or replaced by a mere buffer
        return SafeConsole(stderr=stderr, emoji=False)


class _SurvivingText(io.TextIOWrapper):
    """Text stream that goes to the null device once it takes no more, as on a full disk."""

    def write(self, text: str, /) -> int:
        try:
            return super().write(text)
        except OSError as error:
            self._give_up(error)
            return len(text)

    def flush(self) -> None:
        try:
            super().flush()
        except OSError as error:
            self._give_up(error)

    def _give_up(self, error: OSError) -> None:
        with Path(os.devnull).open("wb") as null:
            os.dup2(null.fileno(), self.fileno())
        if error.errno not in (errno.EPIPE, errno.EIO):  # its reader or terminal is not gone
            sys.stderr.write(f"warning: the output is cut short: {error.strerror}\n")


def survive_lost_readers() -> None:
    """Let standard output and error outlive their reader or disk: a command finishes its files."""
    for name in ("stdout", "stderr"):
        old = getattr(sys, name)
        buffer = io.BufferedWriter(io.FileIO(old.fileno(), "wb", closefd=False))
        new = _SurvivingText(buffer, old.encoding, old.errors, line_buffering=True)
        setattr(sys, name, new)


class _Lines(io.TextIOBase):
    """Text stream that passes on complete lines instead of writing them."""

    def __init__(self, show: Callable[[str], None], replaced: TextIO) -> None:
        super().__init__()
        self._show = show
        self._replaced = replaced
        self._partial = ""

    def fileno(self) -> int:
        return self._replaced.fileno()

    def write(self, text: str) -> int:
        *lines, partial = (self._partial + text).replace("\r", "\n").split("\n")
        if len(partial) > MAX_LINE:
            lines, partial = [*lines, partial], ""
        self._partial = partial
        for line in filter(None, lines):
            self._show(line)
        return len(text)

    def finish(self) -> None:
        """Pass on an unfinished last line. A policy may have kept the stream and print later."""
        self.write("\n")


@contextmanager
def stray_lines_shown(show: Callable[[str], None], console: IO[str]) -> Iterator[None]:
    """Redirect every line printed to the file of ``console`` to ``show``, so that no thread waits
    for it.

    This covers standard error (logging, warnings, tracebacks of threads) and standard output, each
    if it is that file: one sent elsewhere keeps its lines.
    """
    replaced = {name: getattr(sys, name) for name in ("stdout", "stderr")}
    shown = {
        name: _Lines(show, stream)
        for name, stream in replaced.items()
        if _is_same_file(stream, console)
    }
    for name, lines in shown.items():
        setattr(sys, name, lines)
    try:
        yield
    finally:
        for name, lines in shown.items():
            setattr(sys, name, replaced[name])
            lines.finish()


def _is_same_file(stream: TextIO | None, other: IO[str]) -> bool:
    try:
        return stream is not None and os.path.sameopenfile(stream.fileno(), other.fileno())
    except (OSError, ValueError, AttributeError):  # closed, in memory, or a policy's own stream
        return False
