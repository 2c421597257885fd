"""``jpeg-udp:[HOST:]PORT``: pictures in chunks over UDP, as sent by racing simulators.

A datagram is ``HEADER`` and a part of a JPEG or PNG. Chunks may be lost, repeated or out of order.
"""

import logging
import select
import socket
from dataclasses import dataclass, field
from struct import Struct
from typing import NamedTuple

from mavbridge.camera.grabber import Image
from mavbridge.camera.pipe_frames import MAX_JPEG_BYTES, DamageCount, decode_picture
from mavbridge.core.address import LOOPBACK, host_port, spelled
from mavbridge.core.clock import NS_PER_S, Clock
from mavbridge.core.errors import CameraError, UserError

FORM = "jpeg-udp:[HOST:]PORT, such as jpeg-udp:5600 or jpeg-udp:[::1]:5600"
HEADER = Struct("<IHHIIQ")
"""Frame id, chunk number, number of chunks, bytes of the picture and of the chunk, stamp [ns]."""
MAX_PARTIAL = 4
"""Largest number of incomplete frames; bounds the memory together with MAX_JPEG_BYTES."""
RESTART_NS = NS_PER_S
"""Time without a whole frame after which a lower frame id means that the sender has restarted."""
SILENT_NS = 2 * NS_PER_S
"""Longest wait for a whole frame."""
_POLL_S = 0.1
_RECEIVE_BUFFER_BYTES = 4 << 20
_MOST_QUEUED = 4096
"""Limit of datagrams read at a time, in case the sender is faster than this computer."""
_log = logging.getLogger(__name__)


def parse_jpeg_udp(text: str) -> tuple[str, int]:
    """Return the host and port after ``jpeg-udp:``; without a host, the loopback address.

    Raises:
        UserError: it is malformed.
    """
    found = host_port(text if ":" in text else f"{LOOPBACK}:{text}")
    if found is None:
        raise UserError(f"--camera {f'jpeg-udp:{text}'!r}: use {FORM}")
    return found


class FrameKey(NamedTuple):
    """Header fields common to all chunks of one frame."""

    frame_id: int
    chunks: int
    size_bytes: int
    stamp_ns: int
    """Stamp of the sender's clock."""


@dataclass(slots=True)
class Assembly:
    """Received chunks of one frame."""

    key: FrameKey
    arrived_ns: int
    """Arrival of the first chunk."""
    parts: dict[int, bytes] = field(default_factory=dict)
    size_bytes: int = 0

    @property
    def picture(self) -> bytes:
        """All chunks, joined in order."""
        return b"".join(self.parts[chunk] for chunk in range(self.key.chunks))


class FrameAssembler:
    """Assembles frames from datagrams in any order; each returned frame is newer than the last."""

    def __init__(self) -> None:
        self.malformed = 0
        """Ignored datagrams, and frames whose chunks do not add up to their size."""
        self.incomplete = 0
        """Frames given up with chunks missing."""
        self._partial: dict[FrameKey, Assembly] = {}
        """Incomplete frames, least recently continued first."""
        self._last: FrameKey | None = None
        self._whole_ns = 0

    def put(self, datagram: bytes, arrived_ns: int) -> Assembly | None:
        """Process a datagram. Return the frame that it completes, or None.

        A malformed datagram is counted and ignored; one of an old frame is ignored.
        """
        header = HEADER.unpack_from(datagram.ljust(HEADER.size, b"\0"))
        frame_id, chunk, chunks, size_bytes, length, stamp_ns = header
        payload = datagram[HEADER.size : HEADER.size + length]  # padding is allowed
        is_chunk = chunk < chunks and 0 < length == len(payload)
        if not is_chunk or not max(chunks, length) <= size_bytes <= MAX_JPEG_BYTES:
            self.malformed += 1
            return None
        key = FrameKey(frame_id, chunks, size_bytes, stamp_ns)
        if not self._is_news(key, arrived_ns):
            return None
        frame = self._partial.pop(key, None) or Assembly(key, arrived_ns)
        if chunk not in frame.parts:
            frame.parts[chunk] = payload
            frame.size_bytes += length
        is_whole = len(frame.parts) == chunks
        if frame.size_bytes > size_bytes or (is_whole and frame.size_bytes < size_bytes):
            self.malformed += 1
            return None
        if is_whole:
            self._last, self._whole_ns = key, arrived_ns
            given_up = [each for each in self._partial if not self._is_news(each, arrived_ns)]
        else:
            self._partial[key] = frame
            given_up = [*self._partial][:-MAX_PARTIAL]
        for each in given_up:
            del self._partial[each]
        self.incomplete += len(given_up)
        return frame if is_whole else None

    def _is_news(self, key: FrameKey, now_ns: int) -> bool:
        """True if the frame is newer than the last whole one; ids wrap around."""
        last = self._last
        if last is None or 0 < (key.frame_id - last.frame_id) % (1 << 32) < 1 << 31:
            return True
        return key != last and now_ns - self._whole_ns >= RESTART_NS


class JpegUdpSource:
    """`ImageSource` over a UDP port; returns the newest whole frame."""

    def __init__(self, host: str, port: int, *, clock: Clock) -> None:
        """Bind the port. Raises CameraError on failure."""
        self._name = f"jpeg-udp:{spelled(host, port)}"
        self._clock = clock
        self._frames = FrameAssembler()
        self._datagrams = 0
        self._damage = DamageCount(self._name)
        self._silent_after_ns = clock.now_ns() + SILENT_NS
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER_BYTES)
        self._socket.setblocking(False)
        try:
            self._socket.bind((host, port))
        except OSError as error:
            self.close()
            raise CameraError(f"{self._name} cannot be opened: {error.strerror}") from error

    def next_image(self) -> Image | None:
        """See `ImageSource`."""
        if (frame := self._newest_frame()) is None:
            if self._clock.now_ns() > self._silent_after_ns:
                raise CameraError(
                    f"{self._name}: no whole frame in {SILENT_NS / NS_PER_S:g} s: {self._counts}"
                )
            return None
        self._silent_after_ns = self._clock.now_ns() + SILENT_NS
        pixels = decode_picture(frame.picture)
        self._damage.note(pixels)
        return None if pixels is None else Image(frame.arrived_ns, pixels, frame.key.stamp_ns)

    def _newest_frame(self) -> Assembly | None:
        """Drain the socket, which may hold several frames."""
        newest: Assembly | None = None
        for number in range(_MOST_QUEUED):
            if (datagram := self._receive(0.0 if number else _POLL_S)) is None:
                break
            self._datagrams += 1
            newest = self._frames.put(datagram, self._clock.now_ns()) or newest
        return newest

    def _receive(self, timeout_s: float) -> bytes | None:
        try:
            ready, _, _ = select.select([self._socket], [], [], timeout_s)
            return self._socket.recv(1 << 16) if ready else None
        except BlockingIOError:  # a datagram with a wrong checksum
            return None
        except OSError as error:
            raise CameraError(f"{self._name}: {error.strerror}") from error

    @property
    def _counts(self) -> str:
        if not self._datagrams:
            return (
                "no datagram has come: check that the sender sends to this address (from other "
                "computers: jpeg-udp:0.0.0.0:PORT)"
            )
        return (
            f"of {self._datagrams} datagrams {self._frames.malformed} were malformed (a header of "
            f"{HEADER.size} bytes and a chunk are expected), {self._frames.incomplete} frames "
            "incomplete"
        )

    def close(self) -> None:
        """See `ImageSource`."""
        if self._frames.malformed or self._frames.incomplete:
            _log.info("%s: %s", self._name, self._counts)
        self._socket.close()
