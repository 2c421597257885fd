"""``link.tlog``: the packet log, from the link's process to the recording's writer process.

The records come through a separate pipe, so that the log continues after the flight process has
died. ``mavbridge.mavlink.codec.tlog`` makes them.
"""

import os
from multiprocessing.connection import Connection, Pipe, wait
from pathlib import Path
from typing import NamedTuple, Never

READ_BYTES = 1 << 16


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


class TlogFile:
    """The file, which grows by what has come through the pipe."""

    def __init__(self, path: Path, records: "Connection[Never, Never]") -> None:
        """Append to ``path``. Nobody else uses the pipe from here on."""
        self._path, self._records = path, records
        self.has_ended = False
        """True at the end of the pipe."""

    def copy(self) -> None:
        """Append the pending data of the pipe; raise OSError if they cannot be written."""
        with self._path.open("ab") as file:
            while not self.has_ended and wait([self._records], 0):
                data = os.read(self._records.fileno(), READ_BYTES)
                file.write(data)
                self.has_ended = not data
