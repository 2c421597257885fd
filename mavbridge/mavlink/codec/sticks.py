"""Bytes <-> records, with no socket and no clock; the wire's sentinels and last refusals."""

from collections.abc import Iterator

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.records import Sticks
from mavbridge.mavlink.codec.calibration import Pwm, RcCalibration
from mavbridge.mavlink.codec.fast_packets import STATE_READERS, decode_state_packet, pack_override
from mavbridge.mavlink.codec.messages import Incoming, Source
from mavbridge.mavlink.codec.readers import READERS, UnusableError

RELEASE_US = 0
"""RC_CHANNELS_OVERRIDE ch 1-8: give the channel back to the receiver."""
IGNORE_US = 65535
"""RC_CHANNELS_OVERRIDE ch 1-8: leave the channel as it is. Not a release."""

PWM_LIMITS_US = (800, 2200)
"""What a radio can send: whatever the vehicle's calibration says, nothing else leaves here."""

_PACKET_STARTS = (b"\xfd", b"\xfe")
"""MAVLink 2 and 1."""


class CommandRefusedError(Exception):
    """A stick command that must not reach a wire. Always a bug upstream of the codec."""


class Codec:
    """One MAVLink 2 endpoint without I/O: owns the parser state and the sending sequence."""

    def __init__(self, *, source_system: int, source_component: int) -> None:
        self.source = Source(source_system, source_component)
        self._mav = dialect.MAVLink(None, srcSystem=source_system, srcComponent=source_component)
        self._mav.robust_parsing = True
        self.bad_data_count = 0

    def forget_partial(self) -> None:
        """Drop an unfinished packet: the next bytes do not continue it."""
        self._mav.buf = bytearray()
        self._mav.buf_index = 0

    def decode_datagram(self, data: bytes) -> Iterator[Incoming]:
        """Messages of one datagram, which nearly always starts with a packet.

        What was left of an earlier one then was cut off, and must not swallow this one. A datagram
        that starts otherwise may be the next piece of a serial stream that somebody cut at will.
        """
        if (state := decode_state_packet(data)) is not None:
            self.forget_partial()
            yield state
            return
        if data[:1] in _PACKET_STARTS:
            self.forget_partial()
        elif not self._mav.buf_len():
            self.bad_data_count += 1
            return
        yield from self.decode(data)

    def decode(self, data: bytes) -> Iterator[Incoming]:
        """Messages completed by these bytes; corrupt bytes and unusable values are counted."""
        for message in self._mav.parse_buffer(data) or ():
            name = message.get_type()
            if name == "BAD_DATA":
                self.bad_data_count += 1
                continue
            reader = _READERS.get(name)
            try:
                body = None if reader is None else reader(message)
            except UnusableError:
                self.bad_data_count += 1
                continue
            source = Source(message.get_srcSystem(), message.get_srcComponent())
            yield Incoming(source, message.get_seq(), name, body)

    def _pack(self, message: dialect.MAVLink_message) -> bytes:
        data: bytes = message.pack(self._mav)
        self._mav.seq = (self._mav.seq + 1) % 256
        return data

    def encode_heartbeat(self) -> bytes:
        """HEARTBEAT of an onboard controller, which no vehicle takes for a pilot's station."""
        return self._pack(
            self._mav.heartbeat_encode(
                dialect.MAV_TYPE_ONBOARD_CONTROLLER,
                dialect.MAV_AUTOPILOT_INVALID,
                0,
                0,
                dialect.MAV_STATE_ACTIVE,
            )
        )

    def encode_override(self, target: Source, pwm_us: Pwm, calibration: RcCalibration) -> bytes:
        """RC_CHANNELS_OVERRIDE holding the four stick channels, the others ignored.

        Args:
            target: the vehicle.
            pwm_us: throttle, yaw, pitch, roll, from ``pwm_of``.
            calibration: which channels they are.

        Raises:
            CommandRefusedError: a value that no radio sends, or a throttle that is a failsafe.
        """
        channels_us = [IGNORE_US] * 8
        for channel, value_us in zip(calibration.channels, pwm_us, strict=True):
            if not PWM_LIMITS_US[0] <= value_us <= PWM_LIMITS_US[1]:
                raise CommandRefusedError(f"{value_us} us on channel {channel.number}")
            channels_us[channel.number - 1] = value_us
        if pwm_us[0] < calibration.throttle_floor_us:
            raise CommandRefusedError(f"throttle {pwm_us[0]} us is a radio failsafe")
        return self._pack_override(target, channels_us)

    def encode_release(self, target: Source, calibration: RcCalibration) -> bytes:
        """RC_CHANNELS_OVERRIDE that gives the four stick channels back."""
        channels_us = [IGNORE_US] * 8
        for channel in calibration.channels:
            channels_us[channel.number - 1] = RELEASE_US
        return self._pack_override(target, channels_us)

    def _pack_override(self, target: Source, channels_us: list[int]) -> bytes:
        data = pack_override(self.source, self._mav.seq, target, channels_us)
        self._mav.seq = (self._mav.seq + 1) % 256
        return data

    def encode_manual_control(self, target_system: int, sticks: Sticks) -> bytes:
        """MANUAL_CONTROL: x forward, y right, r nose right in -1000..1000, z up in 0..1000.

        Raises:
            CommandRefusedError: a stick that is not finite or not in [-1, 1].
        """
        _refuse_bad_sticks(sticks)
        x, y, r = (round(1000 * value) for value in (sticks.pitch, sticks.roll, sticks.yaw))
        z = round(500 * (sticks.throttle + 1))
        return self._pack(self._mav.manual_control_encode(target_system, x, y, z, r, 0))

    def encode_command(self, target: Source, command: int, *params: float) -> bytes:
        """COMMAND_LONG with up to seven parameters."""
        padded = (*params, *(0.0,) * (7 - len(params)))
        return self._pack(self._mav.command_long_encode(*target, command, 0, *padded))

    def encode_param_read(self, target: Source, name: str) -> bytes:
        """PARAM_REQUEST_READ by name."""
        return self._pack(self._mav.param_request_read_encode(*target, name.encode(), -1))

    def encode_timesync(self, ts1: int) -> bytes:
        """TIMESYNC request."""
        return self._pack(self._mav.timesync_encode(0, ts1))

    def encode_stream_request(self, target: Source, stream: int, rate_hz: int) -> bytes:
        """REQUEST_DATA_STREAM, for vehicles that know no message intervals."""
        return self._pack(self._mav.request_data_stream_encode(*target, stream, rate_hz, 1))


def pwm_of(sticks: Sticks, calibration: RcCalibration) -> Pwm:
    """PWM of throttle, yaw, pitch, roll in us.

    Raises:
        CommandRefusedError: a stick that is not finite or not in [-1, 1].
    """
    _refuse_bad_sticks(sticks)
    return calibration.to_pwm_us(sticks)


def manual_control_sticks(sticks: Sticks) -> Sticks:
    """Sticks as MANUAL_CONTROL's integers can express them."""
    return Sticks(
        throttle=round(500 * (sticks.throttle + 1)) / 500 - 1,
        yaw=round(1000 * sticks.yaw) / 1000,
        pitch=round(1000 * sticks.pitch) / 1000,
        roll=round(1000 * sticks.roll) / 1000,
    )


def _refuse_bad_sticks(sticks: Sticks) -> None:
    for name, value in zip(sticks._fields, sticks, strict=True):
        if not -1.0 <= value <= 1.0:  # also false for NaN
            raise CommandRefusedError(f"{name} stick {value!r} is not in [-1, 1]")


_READERS = READERS | STATE_READERS
