"""``link.tlog``: the packet log, from the link's process to the recording's writer process.

The records come through a separate pipe, so that the log continues after the flight process has
died. ``mavbridge.mavlink.codec.tlog`` makes them.
"""

import os
import threading
from multiprocessing.connection import Connection, Pipe, wait
from pathlib import Path
from typing import BinaryIO, NamedTuple, Never

PERIOD_S = 0.05
"""Time between two reads. Waking the reader for each record would cost the link's process time."""
READ_BYTES = 1 << 16
STOP_S = 1.0


class TlogPipe(NamedTuple):
    """Both ends of the pipe, in the process that starts the other two. No child inherits them."""

    reader: "Connection[Never, Never]"
    """For ``Recorder``, which closes it here as soon as the writer process has it."""
    writer: "Connection[Never, Never]"
    """Its ``fileno()`` is passed to the link's process (``pass_fds``). Close it here as soon as
    that process has it, or the log never ends."""

    def close(self) -> None:
        """Close the ends still open here. Can be called twice."""
        self.reader.close()
        self.writer.close()


def open_tlog_pipe() -> TlogPipe:
    """Create the pipe; raise OSError if no descriptors are left."""
    return TlogPipe(*Pipe(duplex=False))


class TlogThread:
    """Thread that copies the pipe to the file until the pipe ends."""

    def __init__(self, path: Path, records: "Connection[Never, Never]") -> None:
        """Start the thread, which alone uses the pipe from here on. No file may be at ``path``."""
        self._path, self._records = path, records
        self._stop = threading.Event()
        self.failure: OSError | None = None
        """Why the log is no longer written; the pipe is then closed."""
        self._thread = threading.Thread(target=self._run, name="mavbridge-tlog", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            with self._records, self._path.open("xb") as file:
                while not self._stop.is_set() and self._copy(file):
                    self._stop.wait(PERIOD_S)
        except OSError as error:
            self.failure = error

    def _copy(self, file: BinaryIO) -> bool:
        """Append the pending data of the pipe; return False at its end."""
        if not wait([self._records], PERIOD_S):
            return True
        data = os.read(self._records.fileno(), READ_BYTES)
        file.write(data)
        file.flush()
        return bool(data)

    def finish(self, timeout_s: float) -> None:
        """Wait at most ``timeout_s`` for the end of the pipe, and end the thread."""
        self._thread.join(timeout_s)
        self._stop.set()
        self._thread.join(STOP_S)  # a hung disk must not keep the process alive
