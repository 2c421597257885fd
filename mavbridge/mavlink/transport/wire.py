"""Transport and codec together: messages in, packets out, reconnecting by itself."""

import threading
from collections.abc import Iterator
from typing import NamedTuple

from mavbridge.core.clock import NS_PER_MS, NS_PER_S, Clock
from mavbridge.mavlink.codec.messages import Incoming
from mavbridge.mavlink.codec.sticks import Codec
from mavbridge.mavlink.transport.sockets import Address, Transport, TransportDownError
from mavbridge.mavlink.transport.tap import PacketTap

REOPEN_NS = NS_PER_S
DRAIN_BUDGET_NS = 4 * NS_PER_MS
"""Longest stretch of reading: a flood must not keep the action loop from its next slot. What is
left stays with the kernel, which drops what it cannot hold."""


class Arrival(NamedTuple):
    """A message and how it came."""

    message: Incoming
    arrived_ns: int
    sender: Address | None


class Wire:
    """The link's bytes; one thread uses it, and another may take sending away from it."""

    def __init__(
        self, transport: Transport, codec: Codec, clock: Clock, tap: PacketTap | None = None
    ) -> None:
        self._transport = transport
        self._codec = codec
        self._clock = clock
        self._tap = tap
        self._reopen_ns: int | None = None
        self._answer_to: Address | None = None
        self._lock = threading.Lock()
        self._is_sealed = False
        self.texts: list[str] = []
        """What a person should know; the reader empties it."""
        self._open(clock.now_ns())

    @property
    def is_down(self) -> bool:
        """The transport is lost, and not open again yet."""
        return self._reopen_ns is not None

    def _open(self, now_ns: int) -> None:
        self._reopen_ns = None
        try:
            self._transport.open()
        except TransportDownError as error:
            self._lose(str(error), now_ns)
            return
        self._codec.forget_partial()
        self._transport.answer_to(self._answer_to)

    def _lose(self, reason: str, now_ns: int) -> None:
        self._transport.close()
        self._reopen_ns = now_ns + REOPEN_NS
        self.texts.append(f"link lost ({reason}); reconnecting")

    def receive(self) -> Iterator[Arrival]:
        """What has arrived; opens the transport again when that is due."""
        now_ns = self._clock.now_ns()
        if self._reopen_ns is not None:
            if now_ns < self._reopen_ns:
                return
            self._open(now_ns)
        try:
            for chunk in self._transport.drain():
                if self._tap is not None:
                    self._tap.received(chunk)
                is_stream = chunk.sender is None
                decode = self._codec.decode if is_stream else self._codec.decode_datagram
                for message in decode(chunk.data):
                    yield Arrival(message, chunk.arrived_ns, chunk.sender)
                if self._clock.now_ns() - now_ns > DRAIN_BUDGET_NS:
                    return
        except TransportDownError as error:
            self._lose(str(error), self._clock.now_ns())

    def wait(self, until_ns: int) -> None:
        """Return when something may have arrived, or at the time."""
        if self.is_down:
            self._clock.sleep_until_ns(until_ns)
        else:
            self._transport.wait(until_ns)

    def answer_to(self, sender: Address | None) -> None:
        """Send to this peer from now on, also after reconnecting."""
        self._answer_to = sender
        self._transport.answer_to(sender)

    def put(self, data: bytes, *, is_last_word: bool = False) -> bool:
        """Send one packet; False: it did not leave."""
        with self._lock:
            if self.is_down or (self._is_sealed and not is_last_word):
                return False
            try:
                has_left = self._transport.send(data)
            except TransportDownError as error:
                self._lose(str(error), self._clock.now_ns())
                return False
            if has_left and self._tap is not None:
                self._tap.sent(data, self._clock.now_ns())
            return has_left

    def seal(self) -> None:
        """From now on only last words leave, whoever else still tries."""
        with self._lock:
            self._is_sealed = True

    def close(self) -> None:
        """Free the socket or port."""
        self._transport.close()
