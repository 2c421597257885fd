"""Shares the link with a ground station by UDP: the vehicle's bytes to it, its packets back."""

import socket
from collections import deque
from collections.abc import Iterator

from mavbridge.core.address import parse_forward, resolve, spelled
from mavbridge.core.clock import Clock
from mavbridge.core.errors import UserError
from mavbridge.mavlink.codec.frames import split_frames
from mavbridge.mavlink.codec.messages import Endpoint
from mavbridge.mavlink.codec.signing import Signing
from mavbridge.mavlink.transport.ground_station import GroundStationRules, Verdict, denial
from mavbridge.mavlink.transport.sockets import Address, new_socket

MAX_DATAGRAMS, MAX_PACKETS = 32, 100
"""From the ground station at one look, whichever comes first; the rest waits for the next."""
MAX_QUEUED_BYTES = 64 * 1024
"""For the ground station between two sends."""
MAX_PACKED = 1200
"""Bytes in one datagram, below any usual MTU; what arrived larger leaves larger."""
_MAX_DATAGRAM = 2048
"""Longest datagram of a ground station; beyond any usual MTU it is no MAVLink, and is cut off."""


def _own_side(station: Address) -> Address:
    """Where to send from: this computer alone, if the ground station runs on it."""
    if len(station) > 2:
        return ("::1" if station[0] == "::1" else "::", 0, 0, 0)
    return ("127.0.0.1" if station[0].startswith("127.") else "", 0)


class Forwarding:
    """The ground station's end; used by one thread, and never waits.

    The link takes and gives packets; whoever opened it here flushes and closes it.

    It sends to the given address, or to the first that talks where it listens, and hears no other.

    Raises:
        UserError: the address is malformed or in use, or its host does not exist.
    """

    def __init__(
        self, spec: str, clock: Clock, *, sticks_win: bool = False, signing: Signing | None = None
    ) -> None:
        """With ``signing`` only packets signed with its key are passed on, and obeyed here."""
        self._signing = signing
        parsed = parse_forward(spec)
        address = resolve(parsed.host, parsed.port)
        self._clock = clock
        self.rules = GroundStationRules(sticks_win=sticks_win)
        self._station: Address | None = None if parsed.listens else address
        self._was_heard = False
        self._queue: deque[bytes] = deque()
        self._queued_bytes = 0
        self.dropped = 0
        """Datagrams for the ground station: the socket, or our queue, was full."""
        self._socket = new_socket(address, socket.SOCK_DGRAM)
        try:
            self._socket.bind(address if parsed.listens else _own_side(address))
        except OSError as error:
            self._socket.close()
            raise UserError(
                f"--forward {spec}: {error.strerror}; stop the program that listens there, or "
                "choose another port"
            ) from error

    def fileno(self) -> int:
        """Descriptor that turns readable when the ground station has sent something."""
        return self._socket.fileno()

    def take_texts(self) -> list[str]:
        """Messages for the user since the last call."""
        texts, self.rules.texts = self.rules.texts, []
        return texts

    def summary(self) -> str | None:
        """What was not passed on, for the user; None: everything was."""
        if not (self.dropped or self.rules.dropped):
            return None
        return (
            f"{self.rules.dropped} packets of the ground station were not passed on, and "
            f"{self.dropped} datagrams for it were lost"
        )

    def pass_on(self, data: bytes) -> None:
        """Queue bytes of the vehicle for `flush`, unchanged."""
        if self._station is None:
            return
        if self._queued_bytes + len(data) > MAX_QUEUED_BYTES:
            self.dropped += 1
            return
        self._queue.append(data)
        self._queued_bytes += len(data)

    def flush(self) -> None:
        """Send what is queued; what the socket does not take now is dropped."""
        while self._queue:
            datagram = self._queue.popleft()
            while self._queue and len(datagram) + len(self._queue[0]) <= MAX_PACKED:
                datagram += self._queue.popleft()
            self._send(datagram)
        self._queued_bytes = 0

    def receive(self, vehicle: Endpoint | None, *, is_engaged: bool) -> Iterator[bytes]:
        """Packets of the ground station for the vehicle, unchanged.

        Args:
            vehicle: who a refused command seems to be answered by; None: it is not answered.
            is_engaged: our sticks are in use, or being given back.
        """
        now_ns, packets = self._clock.now_ns(), 0
        for _ in range(MAX_DATAGRAMS):
            if packets >= MAX_PACKETS:
                return
            try:
                data, sender = self._socket.recvfrom(_MAX_DATAGRAM)
            except BlockingIOError:
                return
            except OSError:  # the network's answer to an earlier send
                continue
            if not self._is_heard(sender):
                continue
            frames, has_rest = split_frames(data)
            packets += len(frames)
            self.rules.dropped += has_rest
            for frame in frames:
                if self._signing is not None and not self._signing.accepts(frame.data):
                    self.rules.dropped += 1
                    continue
                verdict = self.rules.judge(frame, now_ns, is_engaged=is_engaged)
                if verdict is Verdict.PASS:
                    yield frame.data
                elif verdict is Verdict.DENY and vehicle is not None:
                    self._send(denial(frame, vehicle))

    def close(self) -> None:
        """Free the port."""
        self._socket.close()

    def _is_heard(self, sender: Address) -> bool:
        if self._station is None:
            self._station = sender
        if sender != self._station:
            return False
        if not self._was_heard:
            self._was_heard = True
            self.rules.texts.append(f"a ground station at {spelled(*sender)} shares the link")
        return True

    def _send(self, datagram: bytes) -> None:
        if self._station is None:
            return
        try:
            self._socket.sendto(datagram, self._station)
        except BlockingIOError:
            self.dropped += 1
        except OSError:
            pass  # no route, or nobody listens: a ground station may come later
