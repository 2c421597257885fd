"""Transport combined with the codec: receives messages, sends packets, reconnects by itself."""

from collections.abc import Iterator
from typing import NamedTuple, Protocol, TypeAlias

from mavbridge.core.address import SocketAddress
from mavbridge.core.clock import NS_PER_MS, NS_PER_S, Clock
from mavbridge.core.errors import UserError
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.vehicle import AdviceText, Outlet
from mavbridge.mavlink.codec.messages import Endpoint, ReceivedMessage
from mavbridge.mavlink.codec.packets import Codec
from mavbridge.mavlink.codec.readers import UNKNOWN
from mavbridge.mavlink.codec.signing import Refusal
from mavbridge.mavlink.codec.tlog import PacketPipe

REOPEN_NS = NS_PER_S
DRAIN_BUDGET_NS = 2 * NS_PER_MS
"""Time limit of one read pass, so that a flood does not delay the guard's next slot. The rest stays
with the kernel, which drops packets that it cannot hold."""
_MOST_ADVICE = 100
"""Largest number of advice texts: they quote values, which may change without end."""
REFUSED_NS = 100 * NS_PER_MS
"""Time of refused sends after which they count as a problem."""


REFUSALS: dict[Refusal, str] = {
    "unsigned": "refusing packets without a signature: the vehicle does not sign (give it the key "
    "of --signing-key-file), or somebody else sends on this link",
    "wrong key": "refusing packets signed with another key than that of --signing-key-file",
    "replayed": "refusing signed packets that are not newer than those before them: replayed, "
    "doubled or overtaken on the way",
    "clock behind": "refusing signed packets of a sender that is new here, with timestamps of more "
    "than a minute ago: its clock is behind (a vehicle has the time from GPS, or from the tool "
    "that gave it its key), ours is ahead, or they are replayed",
}


Address: TypeAlias = SocketAddress


class Received(NamedTuple):
    """Received bytes and their arrival."""

    data: bytes
    arrived_ns: int
    sender: Address | None
    """Source of a datagram; None on a stream, which has a single peer."""


class TransportDownError(Exception):
    """The peer or the port is gone; reopening may help."""

    is_silence = False
    """True if nothing is known but that no bytes came."""


class Transport(Protocol):
    """Non-blocking connection to a vehicle; not thread-safe."""

    refusal: str = ""
    """Why the system refused the last packet; empty if it took it."""

    def open(self) -> None:
        """Open the socket or port; raise UserError, or TransportDownError if a retry may help."""
        return

    def drain(self) -> Iterator[Received]:
        """Yield everything that has arrived. Raise TransportDownError if the connection is lost."""

    def fileno(self) -> int | None:
        """Return the descriptor that is readable when ``drain`` has data; None if closed."""
        return None

    def receiver(self, peer: Address | None) -> Address | None:
        """Return the destination of ``send``; None on a stream, or if there is none yet."""
        return None

    def send(self, data: bytes, peer: Address | None = None) -> bool:
        """Hand one whole packet to the kernel; return False if it had to be dropped.

        ``peer``: destination of a datagram if we listen, else ignored. Raise TransportDownError if
        the connection is lost.
        """

    def close(self) -> None:
        """Close the socket or port; safe to call twice."""
        return


Arrival: TypeAlias = tuple[ReceivedMessage, int, Address | None]
"""Message, arrival [ns] and source address; a plain tuple for speed."""


class Connection:
    """Non-blocking packet input and output; not thread-safe."""

    def __init__(
        self,
        transport: Transport,
        codec: Codec,
        clock: Clock,
        log: PacketPipe | None = None,
    ) -> None:
        """``log`` receives every packet that is received or sent."""
        self._transport = transport
        self._codec = codec
        self._clock = clock
        self._log = log
        self._reopen_ns: int | None = None
        self._refused_ns: int | None = None
        """First refused send since the last successful one."""
        self.peer: Address | None = None
        """The vehicle's address, to which packets are sent; None until it is found."""
        self._caller: Address | None = None
        """Newest sender, who gets our heartbeats before that: a vehicle that signs may have its
        time from them."""
        self._texts: list[str] = []
        self._advice: set[str] = set()
        """Advice already given."""
        self.received_bytes = 0
        self.received_packets = 0
        """Number of packets with a valid checksum; noise looks like packets of unknown messages,
        which have none to test."""
        self.radio_packets = 0
        """Number of these that a telemetry radio has sent."""
        self._told_signatures = 0
        """Number of kinds of rejected signatures that were reported."""
        self._told_loss = self.loss = ""
        """Last lost connection that was told, and its known cause; empty once bytes have come."""
        self._opened = 0
        self._open(clock.now_ns())

    @property
    def source(self) -> Endpoint:
        """Our own system and component."""
        return self._codec.source

    @property
    def is_down(self) -> bool:
        """True if the transport is lost and not reopened yet."""
        return self._reopen_ns is not None

    def _open(self, now_ns: int) -> None:
        self._reopen_ns = None
        try:
            self._transport.open()
        except (TransportDownError, UserError) as error:
            if isinstance(error, UserError) and not self._opened:
                raise
            self._lose(error, now_ns)
            return
        self._opened += 1
        self._refused_ns = None
        self._codec.forget_partials()

    def report(self, text: str) -> None:
        """Keep a text for the user until `take_texts`; advice only the first time."""
        if isinstance(text, AdviceText):
            if text in self._advice or len(self._advice) >= _MOST_ADVICE:
                return
            self._advice.add(text)
        self._texts.append(text)

    def take_texts(self) -> tuple[str, ...]:
        """Return the messages for the user since the last call."""
        texts, self._texts = tuple(self._texts), []
        return texts

    def fileno(self) -> int | None:
        """Return the descriptor for ``select``; None while there is none."""
        return None if self.is_down else self._transport.fileno()

    @property
    def outlet(self) -> Outlet:
        """Present outlet of packets."""
        fd = self.fileno()
        return Outlet(self._opened, fd, None if fd is None else self._transport.receiver(self.peer))

    def _lose(self, error: TransportDownError | UserError, now_ns: int) -> None:
        self._transport.close()
        self._reopen_ns = now_ns + REOPEN_NS
        is_silence = isinstance(error, TransportDownError) and error.is_silence
        self.loss = "" if is_silence else str(error)
        if str(error) != self._told_loss:
            self._told_loss = str(error)
            self.report(f"connection lost ({error}); reconnecting")

    def receive(self) -> Iterator[Arrival]:
        """Yield the messages that have arrived; reopen the transport when that is due."""
        now_ns = self._clock.now_ns()
        if self._reopen_ns is not None and now_ns >= self._reopen_ns:
            self._open(now_ns)
        if self.is_down:
            return
        try:
            for data, arrived_ns, sender in self._transport.drain():
                self.received_bytes += len(data)
                self._told_loss = self.loss = ""
                self._caller, is_stream = sender, sender is None
                decode = self._codec.decode if is_stream else self._codec.decode_datagram
                for message in decode(data, sender):
                    self.received_packets += message.name != UNKNOWN
                    self.radio_packets += message.name == "RADIO_STATUS"
                    if self._log is not None:
                        self._log.put(arrived_ns, message.packet)
                    yield message, arrived_ns, sender
                self._notice_signatures()
                if self._clock.now_ns() - now_ns > DRAIN_BUDGET_NS:
                    return
        except TransportDownError as error:
            self._lose(error, self._clock.now_ns())

    def _notice_signatures(self) -> None:
        """Report rejected signatures to the user, each kind once."""
        reasons = self.refusals if self.hint is None else [str(self.hint)]
        for text in reasons[self._told_signatures :]:
            self._told_signatures += 1
            self.report(text)

    @property
    def refusals(self) -> list[str]:
        """Why packets were rejected by the signature check, a sentence for each kind."""
        signing = self._codec.signing
        return [] if signing is None else [REFUSALS[refusal] for refusal in signing.refused]

    def obstacles(self, now_ns: int) -> list[str]:
        """Return why no vehicle is heard: the system refuses our packets, or we refuse its."""
        if self.received_bytes or not self.is_refused(now_ns):
            return self.refusals
        if not (refusal := self._transport.refusal):
            return []
        where = "check the address, the network and the firewall"
        return [f"this computer refuses to send there ({refusal}): {where}"]

    @property
    def hint(self) -> Reason | None:
        """Possible reason why the vehicle does not answer, or None."""
        return because(Code.VEHICLE_SIGNS) if self._codec.hears_signed else None

    def is_refused(self, now_ns: int) -> bool:
        """True if the system has refused all our packets for ``REFUSED_NS``."""
        return self._refused_ns is not None and now_ns - self._refused_ns >= REFUSED_NS

    def send(self, data: bytes) -> bool:
        """Send one packet; return False if it was not sent."""
        if self.is_down:
            return False
        try:
            is_sent = self._transport.send(data, self.peer or self._caller)
        except TransportDownError as error:
            self._lose(error, self._clock.now_ns())
            return False
        self._refused_ns = None if is_sent else self._refused_ns or self._clock.now_ns()
        if is_sent and self._log is not None:
            self._log.put(self._clock.now_ns(), data)
        return is_sent

    def close(self) -> None:
        """Close the socket or port."""
        self._transport.close()
