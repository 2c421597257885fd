"""Transport and codec together: messages in, packets out, reconnecting by itself."""

import threading
from collections.abc import Iterator
from typing import NamedTuple, Protocol

from mavbridge.core.clock import NS_PER_MS, NS_PER_S, Clock
from mavbridge.core.vehicle import Packet
from mavbridge.mavlink.codec.messages import ReceivedMessage
from mavbridge.mavlink.codec.packets import Codec
from mavbridge.mavlink.transport.sockets import Address, Transport, TransportDownError

REOPEN_NS = NS_PER_S
DRAIN_BUDGET_NS = 4 * NS_PER_MS
"""Longest stretch of reading: a flood must not keep the action loop from its next slot. What is
left stays with the kernel, which drops what it cannot hold."""


class PacketLog(Protocol):
    """Takes every packet that is received or sent; must neither wait nor raise."""

    def put(self, packet: Packet, /) -> None:
        """Take the packet, or drop and count it."""


class Arrival(NamedTuple):
    """A message with its arrival time and the address that it came from."""

    message: ReceivedMessage
    arrived_ns: int
    sender: Address | None


class Connection:
    """Packets in and out; used by one thread, but another one may stop it from sending."""

    def __init__(
        self,
        transport: Transport,
        codec: Codec,
        clock: Clock,
        log: PacketLog | None = None,
    ) -> None:
        self._transport = transport
        self._codec = codec
        self._clock = clock
        self._log = log
        self._reopen_ns: int | None = None
        self.peer: Address | None = None
        """The vehicle's address, to which packets are sent; None until it is found."""
        self._lock = threading.Lock()
        self._is_blocked = False
        self.texts: list[str] = []
        """Messages for the user; the reader empties the list."""
        self._open(clock.now_ns())

    @property
    def is_down(self) -> bool:
        """The transport is lost and not open again yet."""
        return self._reopen_ns is not None

    def _open(self, now_ns: int) -> None:
        self._reopen_ns = None
        try:
            self._transport.open()
        except TransportDownError as error:
            self._lose(error, now_ns)
            return
        self._codec.forget_partial()

    def _lose(self, error: TransportDownError, now_ns: int) -> None:
        self._transport.close()
        self._reopen_ns = now_ns + REOPEN_NS
        self.texts.append(f"connection lost ({error}); reconnecting")

    def receive(self) -> Iterator[Arrival]:
        """Messages that have arrived; opens the transport again when that is due."""
        now_ns = self._clock.now_ns()
        if self._reopen_ns is not None:
            if now_ns < self._reopen_ns:
                return
            self._open(now_ns)
        try:
            for data, arrived_ns, sender in self._transport.drain():
                is_stream = sender is None
                decode = self._codec.decode if is_stream else self._codec.decode_datagram
                for message in decode(data):
                    if self._log is not None:
                        self._log.put(Packet(arrived_ns, message.packet))
                    yield Arrival(message, arrived_ns, sender)
                if self._clock.now_ns() - now_ns > DRAIN_BUDGET_NS:
                    return
        except TransportDownError as error:
            self._lose(error, self._clock.now_ns())

    def wait(self, until_ns: int) -> None:
        """Return when something may have arrived, or at the given time."""
        if self.is_down:
            self._clock.sleep_until_ns(until_ns)
        else:
            self._transport.wait(until_ns)

    def send(self, data: bytes, *, is_forced: bool = False) -> bool:
        """Send one packet; False: it was not sent. ``is_forced`` overrides ``block_sends``."""
        with self._lock:
            if self.is_down or (self._is_blocked and not is_forced):
                return False
            try:
                is_sent = self._transport.send(data, self.peer)
            except TransportDownError as error:
                self._lose(error, self._clock.now_ns())
                return False
            if is_sent and self._log is not None:
                self._log.put(Packet(self._clock.now_ns(), data))
            return is_sent

    def block_sends(self) -> None:
        """Drop everything that is sent from now on, from any thread, unless it is forced."""
        with self._lock:
            self._is_blocked = True

    def close(self) -> None:
        """Free the socket or port."""
        self._transport.close()
