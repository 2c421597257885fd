"""The course as seen from any other vehicle: its reported pose in, camera frames out.

The vehicle's local NED is taken for the frame of the course, so it must start at the origin,
heading north.
"""

import math
import socket
import sys
from collections.abc import Iterator
from contextlib import closing
from typing import Protocol, TypeAlias

from sitl.camera.fpv import FpvRenderer
from sitl.camera.shm import FramePublisher
from sitl.clock import NS_PER_S, MonotonicClock
from sitl.course.layout import make_course
from sitl.errors import UsageError
from sitl.link.pose_listener import PoseListener
from sitl.stopping import StopRequest

Address: TypeAlias = tuple[str, int]

MESSAGES_PER_FRAME = 2
MAX_MESSAGE_HZ = 200.0
"""What ArduPilot can send with its default loop rate and to spare."""
MAX_READS = 1000
"""Per frame, so that a flood cannot hold the loop."""
READ_BYTES = 65535
CONNECT_TIMEOUT_S = 1.0


def run_follow(
    url: str,
    shm_name: str,
    course_seed: int,
    width: int,
    height: int,
    fps: float,
    stop: StopRequest,
) -> int:
    """Publish the view from the vehicle on ``url`` until ``stop`` is set; returns exit status 0.

    ``url``: ``udp:HOST:PORT`` or ``udpin:`` listens, ``udpout:`` and ``tcp:`` go there. While the
    pose is unknown or older than 1 s no frames are published, which is said once on stderr.

    Raises:
        UsageError: an address that cannot be parsed or bound, a bad name, size or rate.
    """
    if not (math.isfinite(fps) and fps > 0):
        raise UsageError(f"the frame rate must be positive, got {fps}")
    clock = MonotonicClock()
    renderer = FpvRenderer(make_course(course_seed), width, height)
    listener = PoseListener(rate_hz=min(MESSAGES_PER_FRAME * fps, MAX_MESSAGE_HZ))
    period_ns = round(NS_PER_S / fps)
    due_ns = clock.now_ns()
    known: bool | None = None
    with (
        closing(open_wire(url)) as wire,
        closing(FramePublisher(shm_name, width, height)) as publisher,
    ):
        while not stop.is_set():
            clock.sleep_until_ns(due_ns)
            now_ns = clock.now_ns()
            for data in _waiting(wire):
                listener.receive(data, now_ns)
            for packet in listener.outgoing(now_ns):
                wire.send(packet)
            pose = listener.pose_at(now_ns)
            if pose is not None:
                publisher.publish(renderer.render(*pose), now_ns)
            if known != (pose is not None):
                known = pose is not None
                _say(url, known=known)
            due_ns += period_ns * (1 + max(0, clock.now_ns() - due_ns) // period_ns)
    return 0


def _say(url: str, *, known: bool) -> None:
    text = "has a pose: publishing frames" if known else "has no pose younger than 1 s: no frames"
    sys.stderr.write(f"camera: the vehicle on {url} {text}\n")


def _waiting(wire: "Wire") -> Iterator[bytes]:
    """What has arrived, up to MAX_READS pieces."""
    for _ in range(MAX_READS):
        data = wire.read()
        if data is None:
            return
        yield data


class Wire(Protocol):
    """A non-blocking way to the vehicle."""

    def read(self) -> bytes | None:
        """One datagram or chunk; None if nothing waits."""
        ...

    def send(self, data: bytes) -> None:
        """Hand it to the network; what cannot be sent is lost, since all is sent again."""
        ...

    def close(self) -> None:
        """Free the socket."""
        ...


class _Udp:
    """Answers whoever spoke last, or speaks first to ``peer``."""

    def __init__(self, *, bind: Address | None = None, peer: Address | None = None) -> None:
        self._peer = peer
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        if bind is not None:
            try:
                self._socket.bind(bind)
            except OSError as error:
                self._socket.close()
                raise UsageError(f"cannot listen on {bind[0]}:{bind[1]}: {error}") from error

    def read(self) -> bytes | None:
        try:
            data, self._peer = self._socket.recvfrom(READ_BYTES)
        except OSError:
            return None
        return data

    def send(self, data: bytes) -> None:
        if self._peer is None:
            return
        try:
            self._socket.sendto(data, self._peer)
        except OSError:
            return

    def close(self) -> None:
        self._socket.close()


class _Tcp:
    """Connects when there is something to send: so once a second, if the connection is lost."""

    def __init__(self, peer: Address) -> None:
        self._peer = peer
        self._socket: socket.socket | None = None

    def read(self) -> bytes | None:
        if self._socket is None:
            return None
        try:
            data = self._socket.recv(READ_BYTES)
        except BlockingIOError:
            return None
        except OSError:
            data = b""
        if not data:
            self.close()
            return None
        return data

    def send(self, data: bytes) -> None:
        try:
            if self._socket is None:
                self._socket = socket.create_connection(self._peer, CONNECT_TIMEOUT_S)
                self._socket.setblocking(False)
            self._socket.sendall(data)
        except OSError:
            self.close()

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None


def open_wire(url: str) -> Wire:
    """The socket of a URL like ``udp:127.0.0.1:14551``.

    Raises:
        UsageError: malformed, or the port is in use.
    """
    kind, _, rest = url.partition(":")
    host, _, port_text = rest.rpartition(":")
    if not host or not port_text.isdecimal() or not 0 < int(port_text) < 65536:
        raise UsageError(f"{url!r}: want udp:HOST:PORT, udpin:, udpout: or tcp:HOST:PORT")
    address = (host, int(port_text))
    match kind:
        case "udp" | "udpin":
            return _Udp(bind=address)
        case "udpout":
            return _Udp(peer=address)
        case "tcp":
            return _Tcp(address)
    raise UsageError(f"{url!r}: {kind!r} is not one of udp, udpin, udpout, tcp")
