"""MAVLink 2 signatures, made and checked; https://mavlink.io/en/guide/message_signing.html."""

import hashlib
import hmac
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Literal, NamedTuple, TypeAlias

from pymavlink.dialects.v20 import ardupilotmega as dialect

KEY_BYTES = 32
SIGNED = 0x01
"""Incompatible flag of a signed packet."""
SIGNATURE_BYTES = 13
"""Link id, timestamp of six bytes, and the first six bytes of the hash."""
_TIMESTAMP_BYTES, _HASH_BYTES = 6, 6
_FLAGS_AT, _SYSTEM_AT, _ID_AT, _HEADER_BYTES, _CHECKSUM_BYTES = 2, 5, 7, 10, 2
TICK_NS = 10_000
"""Unit of a timestamp, 10 us."""
EPOCH_NS = 1_420_070_400 * 10**9
"""Unix time of 2015-01-01 UTC, from which timestamps count."""
LATEST_TICKS = 2**48 - 2**40
"""No later timestamp is followed: it has 48 bits, and those after it need room."""
MOST_LAG_TICKS = 60 * 10**9 // TICK_NS
"""A stream that was never heard may begin a minute behind our own clock."""
_RADIO_STATUS = 109
"""Made by the telemetry radio itself, which knows no key; nothing is decided by it."""
LINK_ID, LAST_WORDS_LINK_ID = 0, 1
"""Of the packets that the guard sends, and of those that the flight process sends if it dies, which
are signed before: a stream of their own, within ``MOST_LAG_TICKS`` of the other."""
Stream: TypeAlias = tuple[int, int, int]
"""Link id, system and component: timestamps grow within each."""
Refusal: TypeAlias = Literal["unsigned", "wrong key", "replayed", "clock behind"]


class SigningState(NamedTuple):
    """What must survive a restart, so that no packet of the past counts as a new one."""

    sent_ticks: int = 0
    """Newest timestamp that we may have used."""
    heard_ticks: Mapping[Stream, int] = MappingProxyType({})
    """Newest accepted timestamp of each stream."""


class Signing:
    """Signs packets of MAVLink 2, and judges those that come in; used by one thread."""

    def __init__(
        self,
        key: bytes,
        *,
        unix_ns: Callable[[], int],
        state: SigningState = SigningState(),  # noqa: B008 - immutable
    ) -> None:
        """Begin with a key of 32 bytes.

        Args:
            key: shared with the vehicle.
            unix_ns: the time of day; may be wrong, or step back at a restart.
            state: of an earlier process with this key.
        """
        self._key = key
        self.link_id = LINK_ID
        """Of the packets that are signed."""
        self._unix_ns = unix_ns
        self._sent_ticks = state.sent_ticks
        self._remembered = dict(state.heard_ticks)
        self._heard: dict[Stream, int] = {}
        self.refused: dict[Refusal, int] = {}
        """Packets that were refused, by the reason."""
        self.accepted = 0

    @property
    def state(self) -> SigningState:
        """What a later process needs."""
        return SigningState(self._sent_ticks, self._remembered | self._heard)

    def sign(self, packet: bytes, crc_extra: int) -> bytes:
        """The same packet, signed; its checksum changes with it."""
        body = bytearray(packet[1:-_CHECKSUM_BYTES])
        body[_FLAGS_AT - 1] |= SIGNED
        crc: int = dialect.x25crc(bytes(body) + bytes((crc_extra,))).crc
        self._sent_ticks = max(self._sent_ticks + 1, self.now_ticks)
        unsealed = (
            packet[:1]
            + bytes(body)
            + crc.to_bytes(_CHECKSUM_BYTES, "little")
            + bytes((self.link_id,))
            + self._sent_ticks.to_bytes(_TIMESTAMP_BYTES, "little")
        )
        return unsealed + self._hash(unsealed)

    def accepts(self, packet: bytes) -> bool:
        """Judge one whole packet with a right checksum; counts those that are refused."""
        refusal = self._refusal(packet)
        if refusal is None:
            self.accepted += 1
            return True
        self.refused[refusal] = self.refused.get(refusal, 0) + 1
        return False

    def _refusal(self, packet: bytes) -> Refusal | None:
        if packet[0] != dialect.PROTOCOL_MARKER_V2 or not packet[_FLAGS_AT] & SIGNED:
            is_radio = message_id(packet) == _RADIO_STATUS
            return None if is_radio else "unsigned"
        signed, seal = packet[:-_HASH_BYTES], packet[-_HASH_BYTES:]
        if not hmac.compare_digest(self._hash(signed), seal):
            return "wrong key"
        link_id = packet[-SIGNATURE_BYTES]
        ticks = int.from_bytes(signed[-_TIMESTAMP_BYTES:], "little")
        stream = (link_id, packet[_SYSTEM_AT], packet[_SYSTEM_AT + 1])
        if (newest := self._heard.get(stream)) is not None:
            if ticks <= newest:
                return "replayed"
        elif ticks <= (remembered := self._remembered.get(stream, 0)):
            return "replayed"
        elif not remembered and ticks < self.now_ticks - MOST_LAG_TICKS:
            return "clock behind"
        self._heard[stream] = ticks
        # Ours follow, as MAVLink says: a vehicle refuses a sender that is a minute behind it.
        if ticks <= LATEST_TICKS:
            self._sent_ticks = max(self._sent_ticks, ticks)
        return None

    @property
    def now_ticks(self) -> int:
        """The time of day as a timestamp."""
        return max((self._unix_ns() - EPOCH_NS) // TICK_NS, 0)

    def _hash(self, signed: bytes) -> bytes:
        return hashlib.sha256(self._key + signed).digest()[:_HASH_BYTES]


def message_id(packet: bytes) -> int:
    """Number of the message in a whole packet of MAVLink 1 or 2."""
    if packet[0] != dialect.PROTOCOL_MARKER_V2:
        return packet[_SYSTEM_AT]  # where MAVLink 1 has it
    return int.from_bytes(packet[_ID_AT:_HEADER_BYTES], "little")


def is_signed(packet: bytes) -> bool:
    """The packet has a signature, whatever it is worth."""
    return packet[0] == dialect.PROTOCOL_MARKER_V2 and bool(packet[_FLAGS_AT] & SIGNED)
