"""Encoding and decoding of MAVLink packets, with range checks; no socket, no clock."""

import math
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.address import SocketAddress
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.rotation import Quaternion, tilt_rad
from mavbridge.core.switch import RADIO_US
from mavbridge.core.vehicle import Sticks, Velocity
from mavbridge.mavlink.codec.calibration import Pwm, RcCalibration
from mavbridge.mavlink.codec.frames import (
    HEADER,
    MARKER,
    MARKER_V2,
    SIGNED,
    RawPacket,
    checksum,
    frame_at,
)
from mavbridge.mavlink.codec.messages import (
    STICK_END,
    CommandRequest,
    Endpoint,
    ManualControl,
    ParamRequest,
    ParamWrite,
    ReceivedMessage,
    Request,
)
from mavbridge.mavlink.codec.readers import LAYOUTS, NAMES, TEXT_BYTES, UNKNOWN, UnusableError
from mavbridge.mavlink.codec.signing import LAST_WORDS_LINK_ID, LINK_ID, Signing

_RELEASE_US = 0
"""RC_CHANNELS_OVERRIDE, channels 1-8: release the channel to the receiver."""
_IGNORE_US = 65535
"""RC_CHANNELS_OVERRIDE, channels 1-8: leave the channel unchanged. Not a release."""

_TEXT_CHUNKS = 4
"""Most pieces of a long STATUSTEXT, which have a common id."""

MOST_DATAGRAM_BYTES = 4096
"""Bytes that are decoded of one datagram: more than any autopilot or router sends in one. The worst
case takes 0.7 ms; the largest UDP datagram would take 10 ms."""
_MOST_PARTIALS = 16
"""Senders whose unfinished packets are kept."""

GESTURE_Z, MOST_LOW_R = 150, 800
"""PX4 arms and disarms if z < 100 and |r| > 900 for one second; both bounds include a margin."""
MOST_LEAN_RAD = math.radians(85.0)
"""Hard limits of lean, rates, speed and norm, wider than any setting of a flight: excess is a bug
upstream. Neither autopilot limits the lean of a setpoint by itself."""
MOST_RATE_RADPS = 40.0
MOST_SPEED_MPS = 150.0
MOST_NORM_ERROR = 1e-4
"""ArduPilot drops quaternions whose norm is off by 5e-4, and brakes."""
_ATTITUDE_MASK = (
    dialect.ATTITUDE_TARGET_TYPEMASK_BODY_ROLL_RATE_IGNORE
    | dialect.ATTITUDE_TARGET_TYPEMASK_BODY_PITCH_RATE_IGNORE
    | dialect.ATTITUDE_TARGET_TYPEMASK_BODY_YAW_RATE_IGNORE
)
"""Type mask 7; ArduPilot drops a mask that ignores only some of the rates."""
_RATES_MASK = dialect.ATTITUDE_TARGET_TYPEMASK_ATTITUDE_IGNORE
_MAVLINK_VERSION = 3
"""Last field of HEARTBEAT."""
_REST = (0,) * 10
"""Channels 9 to 18 of RC_CHANNELS_OVERRIDE; axes of MANUAL_CONTROL beyond the fourth."""
_VELOCITY_MASK = 0x5C7
"""Ignore position, acceleration and yaw."""


class CommandRefusedError(Exception):
    """Stick command that must not be sent; always a bug upstream of the codec."""


@cache
def _zeros(layout: struct.Struct) -> tuple[float | bytes, ...]:
    """Return the fields of an empty message, in the order of the wire."""
    return layout.unpack(bytes(layout.size))


class Codec:
    """Onboard computer's end of MAVLink 2, without I/O.

    Owns unfinished packets and the sending sequence.
    """

    def __init__(self, *, source_system: int, signing: Signing | None = None) -> None:
        self.source = Endpoint(source_system, dialect.MAV_COMP_ID_ONBOARD_COMPUTER)
        self._sequence = 0
        self._partials: dict[SocketAddress | None, bytes] = {}
        """Beginning of a packet whose end has not arrived, by sender; None: a stream's peer."""
        self.bad_data_count = 0
        self.signing = signing
        """Signs sent packets and checks received ones; None: neither."""
        self.hears_signed = False
        """True if a signed packet arrived and no key is present to check it."""
        self._text_id = 0

    @contextmanager
    def rehearsing(self) -> Iterator[None]:
        """Context manager: encode packets that another process may send later.

        They use up no sequence numbers, and are signed as a separate stream.
        """
        sequence = self._sequence
        if self.signing is not None:
            self.signing.link_id = LAST_WORDS_LINK_ID
        try:
            yield
        finally:
            self._sequence = sequence
            if self.signing is not None:
                self.signing.link_id = LINK_ID

    def forget_partials(self) -> None:
        """Drop the unfinished packets, which the next bytes do not continue."""
        self._partials.clear()

    def decode_datagram(
        self, data: bytes, sender: SocketAddress | None = None
    ) -> Iterator[ReceivedMessage]:
        """Yield the messages of one datagram, which usually holds one or several whole packets.

        It may continue its sender's forwarded serial stream. If it starts with a marker and does
        not complete the sender's unfinished packet, that packet was cut off and is dropped. Bytes
        beyond ``MOST_DATAGRAM_BYTES`` are ignored.
        """
        if len(data) > MOST_DATAGRAM_BYTES:
            data = data[:MOST_DATAGRAM_BYTES]
            self.bad_data_count += 1
        if MARKER.match(data) and (partial := self._partials.get(sender)):
            joined = frame_at(partial + data, 0)
            if joined is None or not joined.is_sound:
                del self._partials[sender]
        yield from self.decode(data, sender)

    def decode(self, data: bytes, sender: SocketAddress | None = None) -> Iterator[ReceivedMessage]:
        """Yield the messages completed by these bytes; count corrupt bytes and unusable values."""
        data, at = self._partials.pop(sender, b"") + data, 0
        while at < len(data):
            if (frame := frame_at(data, at)) is not None:
                at += len(frame.data)
                if (message := self._decoded(frame)) is not None:
                    yield message
            elif MARKER.match(data, at):
                if len(self._partials) >= _MOST_PARTIALS:
                    del self._partials[next(iter(self._partials))]
                self._partials[sender] = data[at:]
                return
            else:
                self.bad_data_count += 1
                start = MARKER.search(data, at)
                at = len(data) if start is None else start.start()

    @property
    def refused_signatures(self) -> int:
        """Number of packets rejected by the signature check."""
        return self.signing.refused.total() if self.signing is not None else 0

    def _decoded(self, frame: RawPacket) -> ReceivedMessage | None:
        """Return the message of a packet; None if it is damaged, or its signature refused."""
        if frame.flags & ~SIGNED or frame.is_sound is False:
            self.bad_data_count += 1
            return None
        if self.signing is None:
            # Noise rarely matches a checksum, but its message ids are unknown.
            self.hears_signed |= frame.flags == SIGNED and frame.is_sound is True
        elif not self.signing.accepts(frame):
            return None
        body, layout, is_unusable = None, LAYOUTS.get(frame.message_id), False
        try:
            body = None if layout is None else layout.read(frame.payload)
        except UnusableError:
            is_unusable = True
            self.bad_data_count += 1
        name = NAMES.get(frame.message_id, UNKNOWN)
        return ReceivedMessage(frame.source, frame.sequence, name, body, frame.data, is_unusable)

    def _pack(self, kind: type[dialect.MAVLink_message], *values: float | bytes) -> bytes:
        """Encode a message from its fields in the order of the wire, and sign it if there is a key.

        pymavlink's packer takes three times as long.
        """
        later = _zeros(kind.unpacker)[len(values) :]  # extensions of a newer dialect
        payload = kind.unpacker.pack(*values, *later).rstrip(b"\0") or b"\0"
        header = HEADER.pack(
            MARKER_V2, len(payload), 0, 0, self._sequence, *self.source, kind.id, 0
        )
        self._sequence = (self._sequence + 1) % 256
        packet: bytes = header + payload
        packet += checksum(packet[1:], kind.crc_extra)
        return packet if self.signing is None else self.signing.sign(packet, kind.crc_extra)

    def encode_heartbeat(self, kind: int = dialect.MAV_TYPE_ONBOARD_CONTROLLER) -> bytes:
        """Encode HEARTBEAT of a MAV_TYPE; by default no ground station."""
        state = (dialect.MAV_AUTOPILOT_INVALID, 0, dialect.MAV_STATE_ACTIVE)
        return self._pack(dialect.MAVLink_heartbeat_message, 0, kind, *state, _MAVLINK_VERSION)

    def encode_override(
        self, target: Endpoint, pwm_us: Pwm | None, calibration: RcCalibration
    ) -> bytes:
        """Encode RC_CHANNELS_OVERRIDE of the four stick channels; the others are left unchanged.

        ``pwm_us`` None releases them to the receiver.

        Raises:
            CommandRefusedError: a value that no radio sends, or a throttle that is a failsafe.
        """
        channels_us = [_IGNORE_US] * 8
        for channel, value_us in zip(
            calibration.channels, pwm_us or (_RELEASE_US,) * 4, strict=True
        ):
            if pwm_us and value_us not in RADIO_US:
                raise CommandRefusedError(f"{value_us} us on channel {channel.number}")
            channels_us[channel.number - 1] = value_us
        if pwm_us and pwm_us[0] < calibration.throttle_floor_us:
            raise CommandRefusedError(f"throttle {pwm_us[0]} us is a radio failsafe")
        kind = dialect.MAVLink_rc_channels_override_message
        return self._pack(kind, *channels_us, *target, *_REST)

    def encode_manual_control(self, target_system: int, sticks: ManualControl) -> bytes:
        """Encode MANUAL_CONTROL.

        Raises:
            CommandRefusedError: a value out of range, which PX4 would replace by the centre, or
                sticks that arm or disarm if held for one second.
        """
        x, y, z, r = sticks
        if not (all(abs(value) <= STICK_END for value in (x, y, r)) and 0 <= z <= STICK_END):
            raise CommandRefusedError(f"MANUAL_CONTROL {tuple(sticks)} is out of range")
        if z <= GESTURE_Z and abs(r) > MOST_LOW_R:
            raise CommandRefusedError(f"MANUAL_CONTROL {tuple(sticks)} may arm or disarm")
        kind = dialect.MAVLink_manual_control_message
        return self._pack(kind, x, y, z, r, 0, target_system, *_REST)

    def encode_attitude(
        self,
        target: Endpoint,
        ned_from_body_wxyz: Quaternion | None,
        rate_body_radps: tuple[float, float, float],
        thrust: float,
        *,
        now_ns: int,
    ) -> bytes:
        """Encode SET_ATTITUDE_TARGET with a collective thrust in [0, 1].

        ``ned_from_body_wxyz`` None: the vehicle flies the body rates, else the attitude alone.

        Raises:
            CommandRefusedError: no unit quaternion, too large a lean or rate, or a bad thrust.
        """
        if not 0.0 <= thrust <= 1.0:  # also false for NaN
            raise CommandRefusedError(f"thrust {thrust!r} is not in [0, 1]")
        mask, quaternion = _ATTITUDE_MASK, ned_from_body_wxyz
        if quaternion is None:
            mask, quaternion = _RATES_MASK, (1.0, 0.0, 0.0, 0.0)
        if not all(abs(rate) <= MOST_RATE_RADPS for rate in rate_body_radps):
            raise CommandRefusedError(f"body rates {rate_body_radps} rad/s")
        if not abs(math.hypot(*quaternion) - 1) <= MOST_NORM_ERROR:
            raise CommandRefusedError(f"{quaternion} is no unit quaternion")
        if not tilt_rad(quaternion) <= MOST_LEAN_RAD:
            raise CommandRefusedError(f"{quaternion} leans too far")
        kind = dialect.MAVLink_set_attitude_target_message
        values = (_stamp_ms(now_ns), *quaternion, *rate_body_radps, thrust)
        return self._pack(kind, *values, *target, mask)

    def encode_velocity(
        self, target: Endpoint, velocity: Velocity, *, is_heading_frame: bool, now_ns: int
    ) -> bytes:
        """Encode SET_POSITION_TARGET_LOCAL_NED with only a velocity and a yaw rate.

        Raises:
            CommandRefusedError: a speed or a yaw rate above the hard limit.
        """
        x, y, z, yaw_rate = velocity
        if not (math.hypot(x, y, z) <= MOST_SPEED_MPS and abs(yaw_rate) <= MOST_RATE_RADPS):
            raise CommandRefusedError(f"velocity {tuple(velocity)}")
        frame = dialect.MAV_FRAME_BODY_NED if is_heading_frame else dialect.MAV_FRAME_LOCAL_NED
        kind, nothing = dialect.MAVLink_set_position_target_local_ned_message, (0.0, 0.0, 0.0)
        values = (_stamp_ms(now_ns), *nothing, x, y, z, *nothing, 0.0, yaw_rate)
        return self._pack(kind, *values, _VELOCITY_MASK, *target, frame)

    def encode_request(self, target: Endpoint, request: Request) -> bytes:
        """Encode COMMAND_LONG, PARAM_REQUEST_READ or PARAM_SET."""
        match request:
            case CommandRequest(command, params):
                padded = (*params, *(0.0,) * (7 - len(params)))
                return self._pack(
                    dialect.MAVLink_command_long_message, *padded, command, *target, 0
                )
            case ParamRequest(name):
                kind, text = dialect.MAVLink_param_request_read_message, name.encode()
                return self._pack(kind, -1, *target, text)
            case ParamWrite(name, value, type_):
                return self._pack(
                    dialect.MAVLink_param_set_message, value, *target, name.encode(), type_
                )

    def encode_timesync(self, ts1: int) -> bytes:
        """Encode a TIMESYNC request."""
        return self._pack(dialect.MAVLink_timesync_message, 0, ts1)

    def encode_statustext(self, text: str) -> list[bytes]:
        """Encode STATUSTEXT, a notice, in one or more packets, truncated after 200 bytes.

        Non-ASCII characters become question marks, since ground stations decode them differently.
        """
        data = text.encode("ascii", "replace")[: TEXT_BYTES * _TEXT_CHUNKS]
        kind, severity = dialect.MAVLink_statustext_message, dialect.MAV_SEVERITY_NOTICE
        if len(data) <= TEXT_BYTES:
            return [self._pack(kind, severity, data, 0, 0)]
        self._text_id = self._text_id % 65535 + 1
        # A zero byte marks the last chunk, so an empty chunk must follow a full one.
        chunks = [data[at : at + TEXT_BYTES] for at in range(0, len(data) + 1, TEXT_BYTES)]
        return [
            self._pack(kind, severity, chunk, self._text_id, sequence)
            for sequence, chunk in enumerate(chunks)
        ]


def pwm_of(sticks: Sticks, calibration: RcCalibration) -> Pwm:
    """Return the PWM of throttle, yaw, pitch, roll [us].

    Raises:
        CommandRefusedError: a stick is not finite or not in [-1, 1].
    """
    _refuse_bad_sticks(sticks)
    return calibration.to_pwm_us(sticks)


def manual_control_of(sticks: Sticks) -> ManualControl:
    """Return sticks as MANUAL_CONTROL's integers.

    With the throttle at the bottom, yaw stays short of PX4's arming and disarming gesture.

    Raises:
        CommandRefusedError: a stick is not finite or not in [-1, 1].
    """
    _refuse_bad_sticks(sticks)
    x, y, r = (round(STICK_END * value) for value in (sticks.pitch, sticks.roll, sticks.yaw))
    z = round(STICK_END / 2 * (sticks.throttle + 1))
    if z <= GESTURE_Z:
        r = min(max(r, -MOST_LOW_R), MOST_LOW_R)
    return ManualControl(x, y, z, r)


def _stamp_ms(now_ns: int) -> int:
    return now_ns // NS_PER_MS % 2**32


def _refuse_bad_sticks(sticks: Sticks) -> None:
    for name, value in zip(sticks._fields, sticks, strict=True):
        if not -1.0 <= value <= 1.0:  # also false for NaN
            raise CommandRefusedError(f"{name} stick {value!r} is not in [-1, 1]")
