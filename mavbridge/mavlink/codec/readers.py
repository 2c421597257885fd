"""Decoder of whole MAVLink 2 packets, and readers: checked records in SI units.

The decoder gives what pymavlink's general parser gives, in less than half the time. It leaves
unusual input to that parser: MAVLink 1, streams, messages with arrays. Only it decodes messages
that pymavlink's dialect lacks.
"""

import math
import struct
from collections import namedtuple
from collections.abc import Callable
from operator import attrgetter
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.rotation import quaternion_from_euler
from mavbridge.core.switch import RADIO_US
from mavbridge.mavlink.codec.messages import (
    STICK_END,
    Altitude,
    Attitude,
    AttitudeTarget,
    AutopilotVersion,
    Body,
    CommandAck,
    CurrentMode,
    Endpoint,
    EstimatorFlags,
    Event,
    Heartbeat,
    LandedState,
    LocalVelocity,
    ManualControl,
    ParamAbsent,
    ParamValue,
    RcChannels,
    ReceivedMessage,
    SpecificForce,
    StatusText,
    SystemStatus,
    Timesync,
    VelocityTarget,
)
from mavbridge.mavlink.codec.signing import SIGNATURE_BYTES, SIGNED

MG_TO_MPS2 = 9.80665e-3
"""Milli-g to m/s^2, by standard gravity."""

_TEXT_BYTES = 50
"""Text of one STATUSTEXT."""
MOST_VALUE = 1e9
"""Largest angle, rate, speed, position or force in SI units: far beyond any vehicle, and its square
is finite in the float32 of policies."""
MOST_NORM_ERROR = 0.1
"""Largest norm error of a quaternion that is normalised; one farther from length 1 is unusable."""
UNPRINTABLE = "\N{REPLACEMENT CHARACTER}"
"""Replaces control characters, which could write into the user's terminal."""
_CHANNELS = attrgetter(*(f"chan{number}_raw" for number in range(1, 19)))
_HIGHRES_ACCEL_FIELDS = 0b111
"""fields_updated bits of xacc, yacc, zacc."""


class UnusableError(Exception):
    """Well-formed message with unusable values."""


def _require_finite(value: float) -> None:
    if not math.isfinite(value):
        raise UnusableError


def _require_usable(*values: float) -> None:
    if not max(map(abs, values)) <= MOST_VALUE or math.isnan(sum(values)):
        raise UnusableError


def _heartbeat(m: dialect.MAVLink_heartbeat_message) -> Body:
    return Heartbeat(m.type, m.autopilot, m.base_mode, m.custom_mode, m.system_status)


def _attitude_quaternion(m: dialect.MAVLink_attitude_quaternion_message) -> Body:
    quaternion = (m.q1, m.q2, m.q3, m.q4)
    rate = (m.rollspeed, m.pitchspeed, m.yawspeed)
    _require_usable(*quaternion, *rate)
    norm = math.hypot(*quaternion)
    if not abs(norm - 1.0) < MOST_NORM_ERROR:
        raise UnusableError
    w, x, y, z = quaternion
    unit = (w / norm, x / norm, y / norm, z / norm)
    return Attitude(True, 1000 * m.time_boot_ms, unit, rate)


def _attitude(m: dialect.MAVLink_attitude_message) -> Body:
    rate = (m.rollspeed, m.pitchspeed, m.yawspeed)
    _require_usable(m.roll, m.pitch, m.yaw, *rate)
    quaternion = quaternion_from_euler(m.roll, m.pitch, m.yaw)
    return Attitude(False, 1000 * m.time_boot_ms, quaternion, rate)


def _local_position(m: dialect.MAVLink_local_position_ned_message) -> Body:
    _require_usable(m.vx, m.vy, m.vz)
    position = (m.x, m.y, m.z)
    is_position = all(abs(metres) <= MOST_VALUE for metres in position)  # also false for NaN
    velocity = (m.vx, m.vy, m.vz)
    return LocalVelocity(1000 * m.time_boot_ms, velocity, position if is_position else None)


def _highres_imu(m: dialect.MAVLink_highres_imu_message) -> Body:
    _require_usable(m.xacc, m.yacc, m.zacc)
    if m.fields_updated & _HIGHRES_ACCEL_FIELDS != _HIGHRES_ACCEL_FIELDS:
        raise UnusableError
    return SpecificForce("HIGHRES_IMU", m.time_usec, (m.xacc, m.yacc, m.zacc))


def _milli_g_imu(
    name: str,
    m: dialect.MAVLink_raw_imu_message | dialect.MAVLink_scaled_imu_message,
    boot_us: int,
) -> Body:
    x, y, z = (value * MG_TO_MPS2 for value in (m.xacc, m.yacc, m.zacc))
    return SpecificForce(name, boot_us, (x, y, z))


def _rc_channels(m: dialect.MAVLink_rc_channels_message) -> Body:
    channels_us = tuple(us if us in RADIO_US else 0 for us in _CHANNELS(m))
    return RcChannels(channels_us[: m.chancount or 18], 1000 * m.time_boot_ms)


def _manual_control(m: dialect.MAVLink_manual_control_message) -> Body:
    if not (all(abs(value) <= STICK_END for value in (m.x, m.y, m.r)) and 0 <= m.z <= STICK_END):
        raise UnusableError  # 32767: the axis does not exist
    return ManualControl(m.x, m.y, m.z, m.r)


def _sys_status(m: dialect.MAVLink_sys_status_message) -> Body:
    present = m.onboard_control_sensors_present & m.onboard_control_sensors_enabled
    return SystemStatus(present, m.onboard_control_sensors_health, m.battery_remaining)


def _command_ack(m: dialect.MAVLink_command_ack_message) -> Body:
    target = Endpoint(m.target_system, m.target_component)
    return CommandAck(command=m.command, result=m.result, target=target)


def _param_value(m: dialect.MAVLink_param_value_message) -> Body:
    if m.param_type == dialect.MAV_PARAM_TYPE_REAL32:
        _require_finite(m.param_value)  # the bytes of an integer may be those of NaN
    return ParamValue(name=m.param_id, value=m.param_value, kind=m.param_type)


def _param_error(m: dialect.MAVLink_param_error_message) -> Body | None:
    is_absent = m.error == dialect.MAV_PARAM_ERROR_DOES_NOT_EXIST
    return ParamAbsent(m.param_id) if is_absent else None


def _status_text(m: dialect.MAVLink_statustext_message) -> Body:
    # pymavlink has stripped zero bytes, and decoded each other byte to one character.
    is_full = m.id != 0 and len(m.text) >= _TEXT_BYTES
    ended = m.text.rstrip("\t") if is_full else m.text.rstrip()  # PX4 ends its texts with a tab
    # Make terminal control codes visible.
    text = "".join(c if c.isprintable() else UNPRINTABLE for c in ended)
    return StatusText(text, m.id, m.chunk_seq, is_full)


def _attitude_target(m: dialect.MAVLink_attitude_target_message) -> Body | None:
    q, rate = tuple(m.q), (m.body_roll_rate, m.body_pitch_rate, m.body_yaw_rate)
    if not math.isfinite(sum((*q, *rate, m.thrust))):
        return None  # no target
    return AttitudeTarget(1000 * m.time_boot_ms, m.type_mask, q, rate, m.thrust)


def _velocity_target(m: dialect.MAVLink_position_target_local_ned_message) -> Body | None:
    velocity = (m.vx, m.vy, m.vz)
    if not math.isfinite(sum(velocity)):
        return None  # no target
    return VelocityTarget(1000 * m.time_boot_ms, m.type_mask, velocity, m.yaw_rate)


def _autopilot_version(m: dialect.MAVLink_autopilot_version_message) -> Body:
    v = m.flight_sw_version
    return AutopilotVersion(f"{v >> 24 & 255}.{v >> 16 & 255}.{v >> 8 & 255}")


READERS: dict[str, Callable[[dialect.MAVLink_message], Body | None]] = {
    "HEARTBEAT": _heartbeat,
    "ATTITUDE": _attitude,
    "ATTITUDE_QUATERNION": _attitude_quaternion,
    "LOCAL_POSITION_NED": _local_position,
    "HIGHRES_IMU": _highres_imu,
    "SCALED_IMU": lambda m: _milli_g_imu("SCALED_IMU", m, 1000 * m.time_boot_ms),
    "SCALED_IMU2": lambda m: _milli_g_imu("SCALED_IMU2", m, 1000 * m.time_boot_ms),
    "RAW_IMU": lambda m: _milli_g_imu("RAW_IMU", m, m.time_usec),
    "RC_CHANNELS": _rc_channels,
    "MANUAL_CONTROL": _manual_control,
    "ATTITUDE_TARGET": _attitude_target,
    "POSITION_TARGET_LOCAL_NED": _velocity_target,
    "GLOBAL_POSITION_INT": lambda m: Altitude(
        m.alt / 1000, m.relative_alt / 1000, 1000 * m.time_boot_ms
    ),
    "CURRENT_MODE": lambda m: CurrentMode(m.custom_mode, m.intended_custom_mode),
    "EVENT": lambda m: Event(m.id),
    "SYS_STATUS": _sys_status,
    "EXTENDED_SYS_STATE": lambda m: LandedState(m.landed_state),
    "EKF_STATUS_REPORT": lambda m: EstimatorFlags(m.flags),
    "ESTIMATOR_STATUS": lambda m: EstimatorFlags(m.flags),
    "COMMAND_ACK": _command_ack,
    "PARAM_VALUE": _param_value,
    "PARAM_ERROR": _param_error,
    "STATUSTEXT": _status_text,
    "TIMESYNC": lambda m: Timesync(tc1=m.tc1, ts1=m.ts1),
    "AUTOPILOT_VERSION": _autopilot_version,
}
"""Reader of each MAVLink message that the bridge uses; raises UnusableError."""

MAVLINK_2 = 0xFD
HEADER = struct.Struct("<BBBBBBBHB")
"""Marker, payload length, incompatible and compatible flags, sequence, system, component, id."""
_HEADER_BYTES, _CHECKSUM_BYTES = 10, 2


class _Layout(NamedTuple):
    """Wire layout of a message; ``fields`` has pymavlink's names, so that one reader serves both.

    An array is always the last field; ``fields`` holds its first element.
    """

    name: str
    crc_extra: int
    payload: struct.Struct
    fields: Any


_LAYOUTS = {
    message.id: _Layout(
        message.msgname,
        message.crc_extra,
        struct.Struct(message.unpacker.format),
        namedtuple(message.msgname, message.ordered_fieldnames),
    )
    for message in dialect.mavlink_map.values()
    if message.msgname == "ATTITUDE_QUATERNION"  # its array comes last, and is not used
    or (message.msgname in READERS and not any(message.array_lengths))
}
_UNREAD: dict[int, str] = {
    message.id: message.msgname
    for message in dialect.mavlink_map.values()
    if message.msgname not in READERS
}
"""Messages of which only the sequence number is used."""

_MISSING_LAYOUTS = {
    436: _Layout(
        "CURRENT_MODE",
        193,
        struct.Struct("<IIB"),
        namedtuple("CURRENT_MODE", "custom_mode intended_custom_mode standard_mode"),
    ),
    410: _Layout(
        "EVENT",
        160,
        struct.Struct("<IIHBBB40s"),
        namedtuple("EVENT", "id time_boot_ms sequence component system log_levels arguments"),
    ),
}
"""Messages of MAVLink's common dialect that pymavlink's ardupilotmega lacks, by id. Layouts from
common.xml; on the wire, fields are sorted by decreasing size."""
MISSING_IDS = {layout.name: number for number, layout in _MISSING_LAYOUTS.items()}
_LAYOUTS |= _MISSING_LAYOUTS
CRC_EXTRA: dict[int, int] = {
    number: message.crc_extra for number, message in dialect.mavlink_map.items()
} | {number: layout.crc_extra for number, layout in _LAYOUTS.items()}
"""Checksum seed (crc_extra) by message id."""


def packet_end(data: bytes, at: int) -> int | None:
    """Return the end of the MAVLink 2 packet at ``at``; None if there is no whole one."""
    if len(data) - at < _HEADER_BYTES + _CHECKSUM_BYTES or data[at] != MAVLINK_2:
        return None
    end = at + _HEADER_BYTES + data[at + 1] + _CHECKSUM_BYTES
    end += SIGNATURE_BYTES if data[at + 2] & SIGNED else 0
    return end if end <= len(data) else None


def decode_packet(data: bytes) -> ReceivedMessage | None:
    """Decode one whole, valid and usable packet without arrays; return None for anything else.

    The caller checks the signature.
    """
    if len(data) < _HEADER_BYTES + _CHECKSUM_BYTES:
        return None
    start, length, incompatible, _, sequence, system, component, low, high = HEADER.unpack_from(
        data
    )
    number = low | high << 16
    layout, unread = _LAYOUTS.get(number), _UNREAD.get(number)
    if start != MAVLINK_2 or incompatible not in (0, SIGNED):
        return None
    crc_extra = CRC_EXTRA.get(number)
    if crc_extra is None or (layout is None and unread is None):
        return None
    sealed = data[:-SIGNATURE_BYTES] if incompatible else data
    if len(sealed) != _HEADER_BYTES + length + _CHECKSUM_BYTES:
        return None
    if checksum(sealed[1:-_CHECKSUM_BYTES], crc_extra) != sealed[-_CHECKSUM_BYTES:]:
        return None
    source = Endpoint(system, component)
    if unread is not None:
        return ReceivedMessage(source, sequence, unread, None, data)
    if layout is None or length > layout.payload.size:
        return None
    payload = sealed[_HEADER_BYTES:-_CHECKSUM_BYTES].ljust(layout.payload.size, b"\0")
    values = layout.payload.unpack(payload)[: len(layout.fields._fields)]
    try:
        body = READERS[layout.name](layout.fields._make(values))
    except UnusableError:
        return None  # the general parser counts it
    return ReceivedMessage(source, sequence, layout.name, body, data)


def checksum(data: bytes, crc_extra: int) -> bytes:
    """Return the CRC-16/MCRF4XX of a packet without its marker, followed by crc_extra."""
    crc: int = dialect.x25crc(data + bytes((crc_extra,))).crc
    return crc.to_bytes(_CHECKSUM_BYTES, "little")


def unread(name: str, packet: bytes) -> ReceivedMessage:
    """Return a message unknown to the dialect; its sequence number is counted."""
    at = 4 if packet[0] == dialect.PROTOCOL_MARKER_V2 else 2
    sequence, system, component = packet[at : at + 3]
    return ReceivedMessage(Endpoint(system, component), sequence, name, None, packet)
