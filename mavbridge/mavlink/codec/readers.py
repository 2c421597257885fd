"""Message by message: pymavlink's values -> our records, checked and in SI units."""

import math
from collections.abc import Callable

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.mavlink.codec.messages import (
    Attitude,
    AutopilotVersion,
    Body,
    CommandAck,
    Heartbeat,
    LocalVelocity,
    ParamValue,
    RcChannels,
    Source,
    SpecificForce,
    StatusText,
    Timesync,
)

MG_TO_MPS2 = 9.80665e-3
"""Milli-g to m/s^2, standard gravity."""

_HIGHRES_ACCEL_FIELDS = 0b111
"""fields_updated bits of xacc, yacc, zacc."""


class UnusableError(Exception):
    """A well-formed message whose values mean nothing."""


def _finite(*values: float) -> None:
    if not math.isfinite(sum(values)):  # NaN and infinity survive every sum
        raise UnusableError


def _heartbeat(m: dialect.MAVLink_heartbeat_message) -> Body:
    return Heartbeat(
        vehicle_type=m.type,
        autopilot=m.autopilot,
        base_mode=m.base_mode,
        custom_mode=m.custom_mode,
    )


def attitude_quaternion(fields: tuple[float, ...]) -> Body:
    """ATTITUDE_QUATERNION from its wire fields."""
    boot_ms, qw, qx, qy, qz, p, q, r = fields[:8]
    _finite(qw, qx, qy, qz, p, q, r)
    if not 0.81 < qw * qw + qx * qx + qy * qy + qz * qz < 1.21:  # the norm, within a tenth of 1
        raise UnusableError
    return Attitude(
        is_quaternion=True,
        boot_ms=int(boot_ms),
        ned_from_body_wxyz=(qw, qx, qy, qz),
        rate_body_radps=(p, q, r),
    )


def _attitude(m: dialect.MAVLink_attitude_message) -> Body:
    rate = (m.rollspeed, m.pitchspeed, m.yawspeed)
    _finite(m.roll, m.pitch, m.yaw, *rate)
    return Attitude(
        is_quaternion=False,
        boot_ms=m.time_boot_ms,
        ned_from_body_wxyz=quaternion_from_euler(m.roll, m.pitch, m.yaw),
        rate_body_radps=rate,
    )


def quaternion_from_euler(
    roll_rad: float, pitch_rad: float, yaw_rad: float
) -> tuple[float, float, float, float]:
    """ned_from_body quaternion (w, x, y, z) of MAVLink's intrinsic Z-Y-X Euler angles."""
    cr, sr = math.cos(roll_rad / 2), math.sin(roll_rad / 2)
    cp, sp = math.cos(pitch_rad / 2), math.sin(pitch_rad / 2)
    cy, sy = math.cos(yaw_rad / 2), math.sin(yaw_rad / 2)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def local_position(fields: tuple[float, ...]) -> Body:
    """LOCAL_POSITION_NED from its wire fields."""
    _, _, _, _, vx, vy, vz = fields
    _finite(vx, vy, vz)
    return LocalVelocity(velocity_ned_mps=(vx, vy, vz))


def highres_imu(fields: tuple[float, ...]) -> Body:
    """HIGHRES_IMU from its wire fields."""
    x, y, z = fields[1:4]
    _finite(x, y, z)
    if int(fields[14]) & _HIGHRES_ACCEL_FIELDS != _HIGHRES_ACCEL_FIELDS:
        raise UnusableError
    return SpecificForce(source="HIGHRES_IMU", specific_force_body_mps2=(x, y, z))


def _milli_g_imu(m: dialect.MAVLink_scaled_imu_message) -> Body:
    x, y, z = (value * MG_TO_MPS2 for value in (m.xacc, m.yacc, m.zacc))
    return SpecificForce(source=m.get_type(), specific_force_body_mps2=(x, y, z))


def _rc_channels(m: dialect.MAVLink_rc_channels_message) -> Body:
    values = (getattr(m, f"chan{number}_raw") for number in range(1, 19))
    return RcChannels(channels_us=tuple(values)[: m.chancount or 18])


def _command_ack(m: dialect.MAVLink_command_ack_message) -> Body:
    target = Source(m.target_system, m.target_component)
    return CommandAck(command=m.command, result=m.result, target=target)


def _param_value(m: dialect.MAVLink_param_value_message) -> Body:
    _finite(m.param_value)
    return ParamValue(name=m.param_id, value=m.param_value)


def _statustext(m: dialect.MAVLink_statustext_message) -> Body:
    return StatusText(text=m.text)


def _timesync(m: dialect.MAVLink_timesync_message) -> Body:
    return Timesync(tc1=m.tc1, ts1=m.ts1)


def _autopilot_version(m: dialect.MAVLink_autopilot_version_message) -> Body:
    v = m.flight_sw_version
    return AutopilotVersion(version=f"{v >> 24 & 255}.{v >> 16 & 255}.{v >> 8 & 255}")


READERS: dict[str, Callable[[dialect.MAVLink_message], Body]] = {
    "HEARTBEAT": _heartbeat,
    "ATTITUDE": _attitude,
    "SCALED_IMU": _milli_g_imu,
    "SCALED_IMU2": _milli_g_imu,
    "RAW_IMU": _milli_g_imu,
    "RC_CHANNELS": _rc_channels,
    "COMMAND_ACK": _command_ack,
    "PARAM_VALUE": _param_value,
    "STATUSTEXT": _statustext,
    "TIMESYNC": _timesync,
    "AUTOPILOT_VERSION": _autopilot_version,
}
"""All but those of ``fast_packets``."""
