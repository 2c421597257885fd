"""``link.tlog``: from the process that owns the link to the one that writes the recording.

The records come through a pipe of their own, so that the log goes on after the flight process has
died. ``mavbridge.mavlink.transport.packet_pipe`` makes them.
"""

import os
import threading
from io import FileIO
from multiprocessing.connection import Connection, Pipe, wait
from pathlib import Path
from typing import NamedTuple, Never

PERIOD_S = 0.05
"""Time between two reads: waking the reader for each record would cost the link's process time."""
READ_BYTES = 1 << 16
STOP_S = 1.0


class TlogPipe(NamedTuple):
    """Both ends of the pipe, in the process that starts the other two; no child inherits them."""

    reader: "Connection[Never, Never]"
    """For ``Recorder``, which closes it here once the writer process has it."""
    writer: "Connection[Never, Never]"
    """Its ``fileno()`` is for the process of the link (``pass_fds``). To be closed here as soon as
    that process has it, or else the log would never end."""

    def close(self) -> None:
        """Close what is still open here. May be called twice."""
        self.reader.close()
        self.writer.close()


class TlogJob(NamedTuple):
    """A log to write."""

    path: Path
    """Must not exist."""
    records: "Connection[Never, Never]"


def open_tlog_pipe() -> TlogPipe:
    """Make the pipe; raises OSError if there are no descriptors left."""
    return TlogPipe(*Pipe(duplex=False))


class TlogThread:
    """Appends what comes through the pipe to the file, until its end."""

    def __init__(self, job: TlogJob) -> None:
        """Start the thread, which alone uses the pipe from here on."""
        self._job = job
        self._stop = threading.Event()
        self.failure: OSError | None = None
        """Why the log is not written any more; the pipe is closed then."""
        self._thread = threading.Thread(target=self._run, name="mavbridge-tlog", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            with self._job.records, self._job.path.open("xb", buffering=0) as file:
                while not self._stop.is_set() and self._copy(file):
                    self._stop.wait(PERIOD_S)
        except OSError as error:
            self.failure = error

    def _copy(self, file: FileIO) -> bool:
        """Append what waits in the pipe; False at its end."""
        if not wait([self._job.records], PERIOD_S):
            return True
        data = os.read(self._job.records.fileno(), READ_BYTES)
        at = 0
        while at < len(data):
            at += file.write(data[at:])
        return bool(data)

    def finish(self, timeout_s: float) -> None:
        """Wait for the end of the pipe, for at most ``timeout_s``, and end the thread."""
        self._thread.join(timeout_s)
        self._stop.set()
        self._thread.join(STOP_S)  # a disk that hangs must not keep the process alive
