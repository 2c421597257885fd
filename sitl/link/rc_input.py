"""The pilot's transmitter, moved by another process: the RC input of ArduPilot's SITL.

A datagram is 8 or 16 little-endian uint16, one PWM value in microseconds a channel. SITL listens on
port 5501; a 0 leaves its channel as it is there. Here all zeros switch the transmitter off, too.
"""

import errno
import socket
import struct

from sitl import UsageError

HOST = "127.0.0.1"
MAX_READS = 100
"""Per call, so that a flood cannot stop the loop."""
_LAYOUTS = {layout.size: layout for layout in (struct.Struct("<8H"), struct.Struct("<16H"))}


class RcInput:
    """A UDP port of this computer that takes receiver values; never blocks.

    Raises:
        UsageError: the port is taken.
    """

    def __init__(self, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((HOST, port))
        except OSError as error:
            self._socket.close()
            reason = "already in use" if error.errno == errno.EADDRINUSE else error.strerror
            raise UsageError(f"--rc-in {port}: {reason}") from error
        self._socket.setblocking(False)

    def latest(self) -> tuple[int, ...] | None:
        """The newest values since the last call, in microseconds; None where nothing came.

        Datagrams of any other size are ignored.
        """
        newest = None
        for _ in range(MAX_READS):
            try:
                data = self._socket.recv(1024)
            except BlockingIOError:
                break
            if layout := _LAYOUTS.get(len(data)):
                newest = layout.unpack(data)
        return newest

    def close(self) -> None:
        """Free the port."""
        self._socket.close()
