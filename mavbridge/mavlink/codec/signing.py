"""MAVLink 2 signatures: https://mavlink.io/en/guide/message_signing.html."""

import hashlib
import hmac
from collections import Counter
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Literal, NamedTuple, TypeAlias

from mavbridge.mavlink.codec.frames import (
    CHECKSUM_BYTES,
    SIGNATURE_BYTES,
    SIGNED,
    RawPacket,
    checksum,
)

KEY_BYTES = 32
_TIMESTAMP_BYTES, _HASH_BYTES = 6, 6
_FLAGS_AT = 2
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
        self._heard = dict(state.heard_ticks)
        self.refused: Counter[Refusal] = Counter()
        """Number of refused packets by reason."""

    @property
    def state(self) -> SigningState:
        """State for a later process."""
        return SigningState(self._sent_ticks, self._heard.copy())

    def sign(self, packet: bytes, crc_extra: int) -> bytes:
        """Return the packet with a signature and the checksum that this requires."""
        body = bytearray(packet[:-CHECKSUM_BYTES])
        body[_FLAGS_AT] |= SIGNED
        self._sent_ticks = max(self._sent_ticks + 1, self.now_ticks)
        unsealed = (
            bytes(body)
            + checksum(bytes(body[1:]), crc_extra)
            + bytes((self.link_id,))
            + self._sent_ticks.to_bytes(_TIMESTAMP_BYTES, "little")
        )
        return unsealed + self._hash(unsealed)

    def accepts(self, frame: RawPacket) -> bool:
        """True if a packet is accepted; count refusals of known messages: others may be noise."""
        refusal = self._refusal(frame)
        if refusal is not None and frame.is_sound:
            self.refused[refusal] += 1
        return refusal is None

    def _refusal(self, frame: RawPacket) -> Refusal | None:
        if not frame.flags & SIGNED:
            return None if frame.message_id == _RADIO_STATUS else "unsigned"
        signed, seal = frame.data[:-_HASH_BYTES], frame.data[-_HASH_BYTES:]
        if not hmac.compare_digest(self._hash(signed), seal):
            return "wrong key"
        ticks = int.from_bytes(signed[-_TIMESTAMP_BYTES:], "little")
        stream = (frame.data[-SIGNATURE_BYTES], *frame.source)
        if (newest := self._heard.get(stream)) is None:
            if ticks < self.now_ticks - MOST_LAG_TICKS:
                return "clock behind"
        elif ticks <= newest:
            return "replayed"
        self._heard[stream] = ticks
        # Our timestamps follow, as MAVLink demands: a vehicle refuses a sender a minute behind it.
        if ticks <= LATEST_TICKS:
            self._sent_ticks = max(self._sent_ticks, ticks)
        return None

    @property
    def now_ticks(self) -> int:
        """Wall time as a timestamp, within its bits."""
        return min(max((self._unix_ns() - EPOCH_NS) // TICK_NS, 0), LATEST_TICKS)

    def _hash(self, signed: bytes) -> bytes:
        return hashlib.sha256(self._key + signed).digest()[:_HASH_BYTES]
