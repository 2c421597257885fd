"""Messages between two processes over a socket pair; neither side ever waits for the other."""

import socket
import struct
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from typing import Protocol

_LENGTH = struct.Struct("<I")
_RECEIVE_BYTES = 1 << 16
_RECEIVES = 16
"""Most reads at once, so that a flood does not keep the reader from its next slot."""
_CLOSED_ON_EXEC: int = getattr(socket, "MSG_CMSG_CLOEXEC", 0)
"""Linux: no child inherits a file that comes."""
_BUFFER_BYTES = 1 << 20
"""Asked of the kernel for each direction: seconds of telemetry, should the other side be busy."""


class Port(Protocol):
    """One end of a channel of messages."""

    is_closed: bool
    """The other end is gone; what it sent before was received."""

    def send(self, message: bytes, fd: int | None = None) -> bool:
        """Hand over a message; False: it was dropped, since the other side does not read.

        With ``fd`` the other side gets a duplicate of that open file.
        """

    def receive(self) -> Sequence[bytes]:
        """Messages that have arrived, in order; never waits."""


def channel_pair() -> tuple[socket.socket, socket.socket]:
    """Two connected sockets; neither is inherited by a child unless it is passed on explicitly."""
    return socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)


class SocketPort:
    """A ``Port`` over one end of ``channel_pair``; used by one thread.

    A stream and not SOCK_SEQPACKET, which macOS lacks: each message follows its length, and the
    rest of one that the kernel took in part goes out before the next. End of file is the news of
    the other process's death.
    """

    def __init__(self, end: socket.socket, *, takes_files: bool = False) -> None:
        """Use this end; open files that come are closed unless ``takes_files``."""
        end.setblocking(False)
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_BYTES)
        self._socket = end
        self._unsent = b""
        self._partial = b""
        self._takes_files = takes_files
        self.files: deque[int] = deque()
        """Open files that have come with messages, in order; the reader takes and closes them."""
        self.is_closed = False
        self.dropped = 0
        """Messages that the other side had no room for."""

    def fileno(self) -> int:
        """The socket, to ``select`` on."""
        return self._socket.fileno()

    def send(self, message: bytes, fd: int | None = None) -> bool:
        """See `Port`."""
        if self._unsent:
            self._unsent = self._put(self._unsent)
        if self._unsent or self.is_closed:
            self.dropped += 1
            return False
        framed = _LENGTH.pack(len(message)) + message
        rest = self._put(framed, fd)
        if len(rest) == len(framed):
            self.dropped += 1
            return False
        self._unsent = rest
        return True

    def _put(self, data: bytes, fd: int | None = None) -> bytes:
        """Write what the kernel takes now; returns the rest."""
        try:
            if fd is not None:
                return data[socket.send_fds(self._socket, [data], [fd]) :]
            return data[self._socket.send(data) :]
        except OSError:
            return data  # no room, or the other side is gone, which the next receive finds out

    def receive(self) -> list[bytes]:
        """See `Port`."""
        messages: list[bytes] = []
        for _ in range(_RECEIVES):
            if self.is_closed:
                break
            try:
                data = self._read()
            except BlockingIOError:
                break
            except OSError:
                data = b""  # reset: the other side died with messages unread
            self.is_closed = not data
            self._partial += data
            at = 0
            while len(self._partial) - at >= _LENGTH.size:
                (length,) = _LENGTH.unpack_from(self._partial, at)
                end = at + _LENGTH.size + length
                if len(self._partial) < end:
                    break
                messages.append(self._partial[at + _LENGTH.size : end])
                at = end
            self._partial = self._partial[at:]
        return messages

    def _read(self) -> bytes:
        if not self._takes_files:
            return self._socket.recv(_RECEIVE_BYTES)
        data, files, _, _ = socket.recv_fds(self._socket, _RECEIVE_BYTES, 1, _CLOSED_ON_EXEC)
        self.files.extend(files)
        return data

    def finish(self, message: bytes, timeout_s: float) -> None:
        """Send the last message and free the socket; waits, for so long, for a reader that lags."""
        self._socket.settimeout(timeout_s)
        with suppress(OSError):
            self._socket.sendall(self._unsent + _LENGTH.pack(len(message)) + message)
        self._socket.close()

    def close(self) -> None:
        """Free the socket: the other side sees the end of file."""
        self._socket.close()
