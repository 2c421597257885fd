"""Hostile MAVLink datagrams: made of every message of the dialect, and of what really was sent.

Everything is drawn from one ``random.Random``, so that a seed gives the same datagrams again.
"""

import math
import re
import struct
from collections import deque
from collections.abc import Callable
from random import Random
from typing import NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.mavlink.codec.messages import Endpoint
from mavbridge.mavlink.codec.readers import READERS

MOST_BYTES = 65_507
"""Payload of the largest UDP datagram."""
_V1, _V2 = 0xFE, 0xFD
_READ = tuple(m.id for m in dialect.mavlink_map.values() if m.msgname in READERS)
_ALL = tuple(dialect.mavlink_map)
_FLOATS = (
    *(math.nan, math.inf, -math.inf, 3.4e38, -3.4e38, 1e-45, -0.0, 0.0),
    *(1.0, -1.0, 0.5, 100.0, -1e9),
)
_NAMES = (
    *(b"RC1_MIN", b"RC3_TRIM", b"RC4_MAX", b"RC2_REVERSED", b"RC8_OPTION", b"RCMAP_ROLL"),
    *(b"RC_OPTIONS", b"RC_OVERRIDE_TIME", b"FS_THR_VALUE", b"FS_THR_ENABLE", b"THR_DZ"),
    *(b"GUID_OPTIONS", b"GUID_TIMEOUT", b"MOT_THST_HOVER", b"MAV_GCS_SYSID", b"ANGLE_MAX"),
    *(b"PILOT_Y_EXPO", b"PILOT_SPD_UP", b"COM_RC_IN_MODE", b"MPC_THR_HOVER", b"NAV_RCL_ACT"),
    *(b"MPC_Z_VEL_MAX_UP", b"MPC_Z_VEL_MAX_DN", b"MPC_MAN_TILT_MAX", b"MPC_YAW_EXPO"),
    *(b"MAN_DEADZONE", b"COM_OF_LOSS_T", b"COM_RCL_EXCEPT"),
)
_TEXTS = (b"", b"\xff\xfe\x80", b"\xc3\x28 %s {0}\n\r", b"\x1b[2J", "Motor ä€🛩".encode(), b"A" * 80)


class Field(NamedTuple):
    """One number or text in the payload of a message."""

    at: int
    code: str
    """As in ``struct``."""
    size: int


def _fields(message: type) -> tuple[Field, ...]:
    fields, at = [], 0
    for count, code in re.findall(r"(\d*)([a-zA-Z])", message.unpacker.format):
        size = struct.calcsize(f"<{count}s" if code == "s" else f"<{code}")
        for _ in range(1 if code == "s" else int(count or 1)):
            fields.append(Field(at, code, size))
            at += size
    return tuple(fields)


FIELDS = {number: _fields(message) for number, message in dialect.mavlink_map.items()}


class Datagrams:
    """An endless source; ``heard`` are the last packets that the real vehicle has sent."""

    def __init__(self, draw: Random) -> None:
        self._draw = draw
        self._sequence = 0
        self.heard: deque[bytes] = deque(maxlen=256)
        self._numbers: tuple[int, ...] | None = None
        self._foreign = (self._garbage, self._valid, self._valid, self._broken, self._unknown)
        self._own = (
            *(self._valid, self._valid, self._valid, self._broken, self._unknown),
            *(self._replayed, self._changed, self._changed, self._changed, self._joined),
        )

    def focus_on_some(self) -> None:
        """Forge one to three kinds of messages from now on, or all again.

        Else a forged reboot, for example, would undo the effect of the others.
        """
        few = self._draw.choice((1, 1, 2, 3))
        is_all = self._draw.random() < 0.3
        self._numbers = None if is_all else tuple(self._draw.choice(_READ) for _ in range(few))

    def foreign(self) -> bytes:
        """Garbage, or a message of any sender but component 1 of system 1."""
        return self._draw.choice(self._foreign)(self._stranger())[:MOST_BYTES]

    def own(self) -> bytes:
        """Mostly a message that seems to be the vehicle's own (system 1, component 1)."""
        is_own = self._draw.random() < 0.9
        source = Endpoint(1, 1) if is_own else self._stranger()
        return self._draw.choice(self._own)(source)[:MOST_BYTES]

    def _stranger(self) -> Endpoint:
        system = self._draw.choice((0, 1, 2, 42, 255, self._draw.randrange(256)))
        component = self._draw.choice((0, 1, 2, 190, 191, self._draw.randrange(256)))
        return Endpoint(system, 7 if (system, component) == (1, 1) else component)

    # --- whole messages

    def _valid(self, source: Endpoint) -> bytes:
        """A sound packet with arbitrary numbers; of MAVLink 1 at times."""
        is_read = self._draw.random() < 0.6
        number = self._draw.choice(self._numbers or (_READ if is_read else _ALL))
        payload = bytearray(dialect.mavlink_map[number].unpacker.size)
        style = self._draw.random()
        for field in FIELDS[number]:
            self._put(payload, field, style)
        return self._sealed(number, bytes(payload), source)

    def _put(self, payload: bytearray, field: Field, style: float) -> None:
        """Write a value: extreme ones, moderate ones, or mostly zeros."""
        draw = self._draw
        if field.code in "sc":
            kind = draw.random()
            text = draw.choice(_NAMES) if kind < 0.5 else draw.choice(_TEXTS)
            value = draw.randbytes(field.size) if kind > 0.8 else text
            payload[field.at : field.at + field.size] = value[: field.size].ljust(field.size, b"\0")
        elif field.code in "fd":
            moderate = draw.uniform(-4.0, 4.0)
            number = moderate if draw.random() < style else draw.choice(_FLOATS)
            struct.pack_into(f"<{field.code}", payload, field.at, number)
        else:
            ones = b"\xff" * field.size
            small = draw.choice((0, 1, 2, 3, 4, 8, 81)).to_bytes(field.size, "little")
            signs = ones[1:] + b"\x7f", b"\0" * (field.size - 1) + b"\x80"
            is_small = draw.random() < style
            values = (small,) if is_small else (ones, *signs, draw.randbytes(field.size))
            payload[field.at : field.at + field.size] = draw.choice(values)

    def _sealed(self, number: int, payload: bytes, source: Endpoint) -> bytes:
        """The packet, with its right checksum."""
        self._sequence = (self._sequence + self._draw.choice((1, 1, 1, 2, 200))) % 256
        extra = bytes((dialect.mavlink_map[number].crc_extra,))
        if number < 256 and self._draw.random() < 0.1:
            body = struct.pack("<5B", len(payload), self._sequence, *source, number) + payload
            return bytes((_V1,)) + body + _checksum(body + extra)
        if self._draw.random() < 0.8:
            payload = payload.rstrip(b"\0") or b"\0"
        head = (len(payload), 0, self._draw.choice((0, 0, 0, 255)), self._sequence, *source)
        body = struct.pack("<6BHB", *head, number & 0xFFFF, number >> 16) + payload
        return bytes((_V2,)) + body + _checksum(body + extra)

    def _unknown(self, source: Endpoint) -> bytes:
        """A message that the dialect has no name for, so that nothing can check it."""
        number = self._draw.randrange(1 << 24)
        if number in dialect.mavlink_map:
            return self._garbage(source)
        payload = self._draw.randbytes(self._draw.randrange(256))
        head = (len(payload), 0, 0, self._draw.randrange(256), *source)
        body = struct.pack("<6BHB", *head, number & 0xFFFF, number >> 16) + payload
        return bytes((_V2,)) + body + self._draw.randbytes(2)

    # --- what was sent before

    def _changed(self, source: Endpoint) -> bytes:
        """A packet of the vehicle with one or two of its fields changed, and its right checksum."""
        frame = self._draw.choice(self.heard) if self.heard else b""
        number = int.from_bytes(frame[7:10], "little")
        is_wanted = number in (self._numbers or FIELDS) and number in FIELDS
        if frame[:1] != bytes((_V2,)) or not is_wanted:
            return self._valid(source)
        size = dialect.mavlink_map[number].unpacker.size
        payload = bytearray(frame[10 : 10 + frame[1]].ljust(size, b"\0"))
        for _ in range(self._draw.choice((1, 1, 2))):
            self._put(payload, self._draw.choice(FIELDS[number]), self._draw.random())
        return self._sealed(number, bytes(payload), source)

    def _replayed(self, source: Endpoint) -> bytes:
        is_likely = self.heard and self._numbers is None
        return self._draw.choice(self.heard) if is_likely else self._changed(source)

    def _joined(self, source: Endpoint) -> bytes:
        """Several packets in one datagram, with or without garbage between."""
        makers: tuple[Callable[[Endpoint], bytes], ...] = (
            *(self._valid, self._changed, self._replayed, self._broken),
            lambda _: self._draw.randbytes(self._draw.randrange(12)),
        )
        pieces = self._draw.choice((2, 3, 5, 5, 20))
        return b"".join(self._draw.choice(makers)(source) for _ in range(pieces))

    # --- broken ones

    def _broken(self, source: Endpoint) -> bytes:
        """Flipped bits, a wrong length, a wrong checksum, cut off, or with too much behind."""
        data = bytearray(self._valid(source))
        match self._draw.randrange(6):
            case 0:
                for _ in range(self._draw.choice((1, 1, 2, 8))):
                    data[self._draw.randrange(len(data))] ^= 1 << self._draw.randrange(8)
            case 1:
                data[1] = self._draw.choice((0, 1, 254, 255, self._draw.randrange(256)))
            case 2:
                data[-1] ^= 0xFF
            case 3:
                del data[self._draw.randrange(len(data)) :]
            case 4:
                data += self._draw.randbytes(self._draw.choice((1, 13, 40)))
            case 5:  # signed flag without a signature, or unknown flags
                data[2] = self._draw.choice((1, 2, 255))
                data += self._draw.randbytes(self._draw.choice((0, 13)))
        return bytes(data)

    def _garbage(self, source: Endpoint) -> bytes:
        draw = self._draw
        if draw.random() < 0.02:  # a huge one, of what costs a parser most
            unit = draw.choice((b"\xfe\0", b"\xfd\0\0\0\0\0", b"\xfd", b"\0", b"\xfe\xff"))
            return (unit * MOST_BYTES)[: draw.choice((2048, 9000, MOST_BYTES))]
        head = draw.choice((b"", b"", b"\xfd", b"\xfe", b"\xfd\x09\0\0"))
        return head + draw.randbytes(draw.choice((0, 1, 5, 12, 40, 280)))


def _checksum(data: bytes) -> bytes:
    return dialect.x25crc(data).crc.to_bytes(2, "little")
