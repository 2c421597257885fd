"""Non-blocking messages between two processes over a socket pair."""

import os
import socket
import struct
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from typing import Protocol

_LENGTH = struct.Struct("<I")
_RECEIVE_BYTES = 1 << 16
_RECEIVES = 16
"""Most reads per call, so that a flood does not delay the reader's next slot."""
_CLOSED_ON_EXEC: int = getattr(socket, "MSG_CMSG_CLOEXEC", 0)
"""Linux: received files are closed on exec, so that no child inherits them."""
_BUFFER_BYTES = 1 << 20
"""Send buffer requested from the kernel, for each direction [bytes]: holds seconds of telemetry
while the other side is busy."""
_FLAGS, _PF_EXITING = 6, 0x4
"""Linux: place of a process's flags behind its name in /proc/PID/stat, and the flag of its exit."""


class Port(Protocol):
    """One end of a channel of messages."""

    is_closed: bool
    """True if the other end is closed and everything that it sent has been received."""

    def send(self, message: bytes, fd: int | None = None) -> bool:
        """Send a message. Return False if it was dropped because the other side does not read.

        With ``fd`` the other side gets a duplicate of that open file.
        """

    def receive(self) -> Sequence[bytes]:
        """Return the messages that have arrived, in order; never block."""


def channel_pair() -> tuple[socket.socket, socket.socket]:
    """Return two connected sockets; a child inherits one only if it is passed explicitly."""
    return socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)


class SocketPort:
    """``Port`` over one end of ``channel_pair``; not thread-safe.

    It uses a stream, since macOS lacks SOCK_SEQPACKET: a length precedes each message, and the
    unsent rest of a message leaves before the next one. End of file means that the other process
    has died; it comes after the process's memory is freed: 90 to 680 ms for 600 MB.
    """

    def __init__(self, end: socket.socket, *, peer_pid: int | None = None) -> None:
        """Use this end, not blocking from now on.

        ``peer_pid``: the other process; on Linux its death is then noticed before end of file.
        """
        end.setblocking(False)
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_BYTES)
        self._socket = end
        self._unsent = b""
        self._partial = b""
        self._peer_stat: int | None = None
        if peer_pid is not None:
            with suppress(OSError):  # no such file on macOS
                self._peer_stat = os.open(f"/proc/{peer_pid}/stat", os.O_RDONLY)
        self.files: deque[int] = deque()
        """Open files received with messages, in order; the reader takes and closes them."""
        self.is_closed = False
        self.dropped = 0
        """Number of messages dropped because the other side had no room."""

    def fileno(self) -> int:
        """Return the socket's descriptor, for ``select``."""
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
        """Write as much as the kernel accepts now; return the rest."""
        try:
            if fd is not None:
                return data[socket.send_fds(self._socket, [data], [fd]) :]
            return data[self._socket.send(data) :]
        except OSError:
            return data  # no room, or the other side is gone: the next receive tells

    def receive(self) -> list[bytes]:
        """See `Port`."""
        messages: list[bytes] = []
        is_last = self._is_peer_exiting()
        for _ in range(_RECEIVES):
            if self.is_closed:
                break
            try:
                data, files, _, _ = socket.recv_fds(
                    self._socket, _RECEIVE_BYTES, 1, _CLOSED_ON_EXEC
                )
                self.files.extend(files)
            except BlockingIOError:
                self.is_closed = is_last
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

    def _is_peer_exiting(self) -> bool:
        if self._peer_stat is None:
            return False
        try:
            stat = os.pread(self._peer_stat, 1024, 0)
        except OSError:
            return True  # its parent has reaped it
        return bool(int(stat.rpartition(b")")[2].split()[_FLAGS]) & _PF_EXITING)

    def finish(self, message: bytes, timeout_s: float) -> None:
        """Send the last message within ``timeout_s``, then close the socket."""
        self._socket.settimeout(timeout_s)
        with suppress(OSError):
            self._socket.sendall(self._unsent + _LENGTH.pack(len(message)) + message)
        self.close()

    def close(self) -> None:
        """Close the socket: the other side reads end of file."""
        self._socket.close()
        if self._peer_stat is not None:
            os.close(self._peer_stat)
            self._peer_stat = None
