"""Readers of payloads: checked records in SI units.

pymavlink's own parser takes twice as long, and lacks two messages.
"""

import math
import struct
from collections import namedtuple
from collections.abc import Callable, Sequence
from operator import attrgetter, itemgetter
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.rotation import quaternion_from_euler
from mavbridge.core.switch import RADIO_US
from mavbridge.mavlink.codec import messages
from mavbridge.mavlink.codec.frames import CURRENT_MODE, EVENT
from mavbridge.mavlink.codec.messages import STICK_END, Body, Endpoint

MG_TO_MPS2 = 9.80665e-3
"""Milli-g to m/s^2, by standard gravity."""

TEXT_BYTES = 50
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


def _require_usable(*values: float) -> None:
    if not max(map(abs, values)) <= MOST_VALUE or math.isnan(sum(values)):
        raise UnusableError


def _text(data: bytes) -> str:
    """Return a text up to its first zero byte, each byte as one character."""
    return data.partition(b"\0")[0].decode("ascii", errors="replace")


def _attitude_quaternion(m: dialect.MAVLink_attitude_quaternion_message) -> Body:
    quaternion = (m.q1, m.q2, m.q3, m.q4)
    rate = (m.rollspeed, m.pitchspeed, m.yawspeed)
    _require_usable(*quaternion, *rate)
    norm = math.hypot(*quaternion)
    if not abs(norm - 1.0) < MOST_NORM_ERROR:
        raise UnusableError
    w, x, y, z = quaternion
    unit = (w / norm, x / norm, y / norm, z / norm)
    return messages.Attitude(True, 1000 * m.time_boot_ms, unit, rate)


def _attitude(m: dialect.MAVLink_attitude_message) -> Body:
    rate = (m.rollspeed, m.pitchspeed, m.yawspeed)
    _require_usable(m.roll, m.pitch, m.yaw, *rate)
    quaternion = quaternion_from_euler(m.roll, m.pitch, m.yaw)
    return messages.Attitude(False, 1000 * m.time_boot_ms, quaternion, rate)


def _local_position(m: dialect.MAVLink_local_position_ned_message) -> Body:
    _require_usable(m.vx, m.vy, m.vz)
    position = (m.x, m.y, m.z)
    is_position = all(abs(metres) <= MOST_VALUE for metres in position)  # also false for NaN
    velocity = (m.vx, m.vy, m.vz)
    return messages.LocalVelocity(
        1000 * m.time_boot_ms, velocity, position if is_position else None
    )


def _highres_imu(m: dialect.MAVLink_highres_imu_message) -> Body:
    _require_usable(m.xacc, m.yacc, m.zacc)
    if m.fields_updated & _HIGHRES_ACCEL_FIELDS != _HIGHRES_ACCEL_FIELDS:
        raise UnusableError
    return messages.SpecificForce("HIGHRES_IMU", m.time_usec, (m.xacc, m.yacc, m.zacc))


def _milli_g_imu(
    name: str,
    m: dialect.MAVLink_raw_imu_message | dialect.MAVLink_scaled_imu_message,
    boot_us: int,
) -> Body:
    x, y, z = (value * MG_TO_MPS2 for value in (m.xacc, m.yacc, m.zacc))
    return messages.SpecificForce(name, boot_us, (x, y, z))


def _rc_channels(m: dialect.MAVLink_rc_channels_message) -> Body:
    channels_us = tuple(us if us in RADIO_US else 0 for us in _CHANNELS(m))
    # ArduPilot counts the receiver's channels, and also fills those that were overridden.
    return messages.RcChannels(channels_us[: max(m.chancount or 18, 8)], 1000 * m.time_boot_ms)


def _manual_control(m: dialect.MAVLink_manual_control_message) -> Body:
    if not (all(abs(value) <= STICK_END for value in (m.x, m.y, m.r)) and 0 <= m.z <= STICK_END):
        raise UnusableError  # 32767: the axis does not exist
    return messages.ManualControl(m.x, m.y, m.z, m.r)


def _sys_status(m: dialect.MAVLink_sys_status_message) -> Body:
    present = m.onboard_control_sensors_present & m.onboard_control_sensors_enabled
    return messages.SystemStatus(present, m.onboard_control_sensors_health, m.battery_remaining)


def _param_value(m: dialect.MAVLink_param_value_message) -> Body:
    # The bytes of an integer may be those of NaN.
    if m.param_type == dialect.MAV_PARAM_TYPE_REAL32 and not math.isfinite(m.param_value):
        raise UnusableError
    return messages.ParamValue(name=_text(m.param_id), value=m.param_value, kind=m.param_type)


def _param_error(m: dialect.MAVLink_param_error_message) -> Body | None:
    is_absent = m.error == dialect.MAV_PARAM_ERROR_DOES_NOT_EXIST
    return messages.ParamAbsent(_text(m.param_id)) if is_absent else None


def _status_text(m: dialect.MAVLink_statustext_message) -> Body:
    text = _text(m.text)
    is_full = m.id != 0 and len(text) >= TEXT_BYTES
    ended = text.rstrip("\t") if is_full else text.rstrip()  # PX4 ends its texts with a tab
    # Make terminal control codes visible.
    text = "".join(c if c.isprintable() else UNPRINTABLE for c in ended)
    return messages.StatusText(text, m.id, m.chunk_seq, is_full)


def _attitude_target(m: dialect.MAVLink_attitude_target_message) -> Body | None:
    q, rate = tuple(m.q), (m.body_roll_rate, m.body_pitch_rate, m.body_yaw_rate)
    if not math.isfinite(sum((*q, *rate, m.thrust))):
        return None  # no target
    return messages.AttitudeTarget(rate, m.thrust)


def _velocity_target(m: dialect.MAVLink_position_target_local_ned_message) -> Body | None:
    velocity = (m.vx, m.vy, m.vz)
    if not math.isfinite(sum(velocity)):
        return None  # no target
    return messages.VelocityTarget(m.type_mask, velocity)


def _autopilot_version(m: dialect.MAVLink_autopilot_version_message) -> Body:
    v = m.flight_sw_version
    return messages.AutopilotVersion(f"{v >> 24 & 255}.{v >> 16 & 255}.{v >> 8 & 255}")


READERS: dict[str, Callable[[dialect.MAVLink_message], Body | None]] = {
    "HEARTBEAT": lambda m: messages.Heartbeat(
        m.type, m.autopilot, m.base_mode, m.custom_mode, m.system_status
    ),
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
    "GLOBAL_POSITION_INT": lambda m: messages.Altitude(
        m.alt / 1000, m.relative_alt / 1000, 1000 * m.time_boot_ms
    ),
    "CURRENT_MODE": lambda m: messages.CurrentMode(m.custom_mode, m.intended_custom_mode),
    "EVENT": lambda m: messages.Event(m.id, m.sequence),
    "SYS_STATUS": _sys_status,
    "EXTENDED_SYS_STATE": lambda m: messages.LandedState(m.landed_state),
    "EKF_STATUS_REPORT": lambda m: messages.EstimatorFlags(m.flags),
    "ESTIMATOR_STATUS": lambda m: messages.EstimatorFlags(m.flags),
    "COMMAND_ACK": lambda m: messages.CommandAck(
        m.command, m.result, Endpoint(m.target_system, m.target_component)
    ),
    "PARAM_VALUE": _param_value,
    "PARAM_ERROR": _param_error,
    "STATUSTEXT": _status_text,
    "TIMESYNC": lambda m: messages.Timesync(tc1=m.tc1, ts1=m.ts1),
    "AUTOPILOT_VERSION": _autopilot_version,
}
"""Reader of each MAVLink message that the bridge uses; raises UnusableError."""


class Layout(NamedTuple):
    """Wire layout of a message that is read."""

    name: str
    payload: struct.Struct
    pick: Callable[[tuple[Any, ...]], tuple[Any, ...]]
    """Takes the fields from the unpacked numbers: an array has several."""
    fields: Any
    """Record with pymavlink's names of the fields, in the order of the wire."""

    def read(self, payload: bytes) -> Body | None:
        """Return the record of a payload, whose trailing zeros may be missing.

        Raises:
            UnusableError: the values are unusable.
        """
        size = self.payload.size
        values = self.payload.unpack(payload[:size].ljust(size, b"\0"))
        return READERS[self.name](self.fields._make(self.pick(values)))


def _layout(name: str, format_: str, fields: Sequence[str], lengths: Sequence[int] = ()) -> Layout:
    """Return a layout; ``lengths``: numbers in each field if there are arrays, else empty."""
    places: list[int | slice] = []
    at = 0
    for length in lengths or (1,) * len(fields):
        places.append(at if length == 1 else slice(at, at + length))
        at += length
    return Layout(name, struct.Struct(format_), itemgetter(*places), namedtuple(name, fields))


LAYOUTS = {
    m.id: _layout(m.msgname, m.unpacker.format, m.ordered_fieldnames, m.lengths)
    for m in dialect.mavlink_map.values()
    if m.msgname in READERS
} | {
    # On the wire, fields are sorted by decreasing size.
    CURRENT_MODE: _layout(
        "CURRENT_MODE", "<IIB", ("custom_mode", "intended_custom_mode", "standard_mode")
    ),
    EVENT: _layout(
        "EVENT",
        "<IIHBBB40s",
        ("id", "time_boot_ms", "sequence", "component", "system", "log_levels", "arguments"),
    ),
}
"""Layout of each message that is read, by its number."""
IDS: dict[str, int] = {m.msgname: m.id for m in dialect.mavlink_map.values()} | {
    layout.name: number for number, layout in LAYOUTS.items()
}
"""Number of each message."""
NAMES: dict[int, str] = {number: name for name, number in IDS.items()}
UNKNOWN = "UNKNOWN"
"""Name of all messages that the dialect lacks."""
