"""MAVLink 2 signatures: https://mavlink.io/en/guide/message_signing.html."""

import hashlib
import hmac
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Literal, NamedTuple, TypeAlias

from pymavlink.dialects.v20 import ardupilotmega as dialect

KEY_BYTES = 32
SIGNED = 0x01
"""Incompatibility flag of a signed packet."""
SIGNATURE_BYTES = 13
"""Link id, timestamp (6 bytes) and the first 6 bytes of the hash."""
_TIMESTAMP_BYTES, _HASH_BYTES = 6, 6
_FLAGS_AT, _SYSTEM_AT, _ID_AT, _HEADER_BYTES, _CHECKSUM_BYTES = 2, 5, 7, 10, 2
TICK_NS = 10_000
"""Unit of a timestamp, 10 us."""
EPOCH_NS = 1_420_070_400 * 10**9
"""Unix time of the timestamps' epoch, 2015-01-01 UTC."""
LATEST_TICKS = 2**48 - 2**40
"""Latest received timestamp to follow: the 48-bit range must leave room for later ones."""
MOST_LAG_TICKS = 60 * 10**9 // TICK_NS
"""Largest lag behind our clock at which an unknown stream is accepted: one minute."""
_RADIO_STATUS = 109
"""From the telemetry radio, which has no key: accepted unsigned, as nothing depends on it."""
LINK_ID, LAST_WORDS_LINK_ID = 0, 1
"""Link ids of the guard's packets, and of the last words. Those are signed in advance as a separate
stream, within ``MOST_LAG_TICKS`` of the guard's."""
Stream: TypeAlias = tuple[int, int, int]
"""Link id, system and component; timestamps increase within each stream."""
Refusal: TypeAlias = Literal["unsigned", "wrong key", "replayed", "clock behind"]


class SigningState(NamedTuple):
    """State to keep across restarts, so that no old packet is accepted as new."""

    sent_ticks: int = 0
    """Upper bound of the timestamps that we have used."""
    heard_ticks: Mapping[Stream, int] = MappingProxyType({})
    """Newest accepted timestamp of each stream."""


class Signing:
    """Signs MAVLink 2 packets and checks received ones; not thread-safe."""

    def __init__(
        self,
        key: bytes,
        *,
        unix_ns: Callable[[], int],
        state: SigningState = SigningState(),  # noqa: B008 - immutable
    ) -> None:
        """Start with a key and a saved state.

        Args:
            key: 32 bytes, shared with the vehicle.
            unix_ns: wall time; may be wrong, or step back at a restart.
            state: state of an earlier process with this key.
        """
        self._key = key
        self.link_id = LINK_ID
        """Link id of the packets that are signed."""
        self._unix_ns = unix_ns
        self._sent_ticks = state.sent_ticks
        self._remembered = dict(state.heard_ticks)
        self._heard: dict[Stream, int] = {}
        self.refused: dict[Refusal, int] = {}
        """Number of refused packets by reason."""
        self.accepted = 0

    @property
    def state(self) -> SigningState:
        """State for a later process."""
        return SigningState(self._sent_ticks, self._remembered | self._heard)

    def sign(self, packet: bytes, crc_extra: int) -> bytes:
        """Return the packet with a signature and the checksum that this requires."""
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
        """True if a whole packet with a valid checksum is accepted; count refusals."""
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
        # Our timestamps follow, as MAVLink demands: a vehicle refuses a sender a minute behind it.
        if ticks <= LATEST_TICKS:
            self._sent_ticks = max(self._sent_ticks, ticks)
        return None

    @property
    def now_ticks(self) -> int:
        """Wall time as a timestamp."""
        return max((self._unix_ns() - EPOCH_NS) // TICK_NS, 0)

    def _hash(self, signed: bytes) -> bytes:
        return hashlib.sha256(self._key + signed).digest()[:_HASH_BYTES]


def message_id(packet: bytes) -> int:
    """Return the message id of a whole packet of MAVLink 1 or 2."""
    if packet[0] != dialect.PROTOCOL_MARKER_V2:
        return packet[_SYSTEM_AT]  # MAVLink 1 has the message id here
    return int.from_bytes(packet[_ID_AT:_HEADER_BYTES], "little")


def is_signed(packet: bytes) -> bool:
    """True if the packet has a signature, valid or not."""
    return packet[0] == dialect.PROTOCOL_MARKER_V2 and bool(packet[_FLAGS_AT] & SIGNED)
