"""Telemetry: MAVLink messages from the autopilot's state, in the units that PX4 uses.

pymavlink's ardupilotmega dialect lacks EVENT(410) and CURRENT_MODE(436). They are packed here by
their definitions in MAVLink's common and development sets.
"""

import math
import struct
from collections.abc import Callable, Hashable

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.clock import NS_PER_MS
from sitl.link.server import Message
from sitl.link.telemetry import Home, boot_ms, boot_us, extended_sys_state, sys_status, vfr_hud
from sitl.px4.autopilot import Px4
from sitl.px4.commander import Event
from sitl.px4.flight import PositionSetpoint
from sitl.px4.modes import Px4Mode
from sitl.vehicle.config import Px4Release
from sitl.vehicle.rotation import conjugate, rotate

CURRENT_MODE = 436
EVENT = 410
EVENT_CRC_EXTRA, CURRENT_MODE_CRC_EXTRA = 160, 193
_EVENT = struct.Struct("<IIHBBB40s")
_CURRENT_MODE = struct.Struct("<IIB")
EVENT_ARGUMENT_BYTES = 40

HOME = Home(47.397743, 8.545594, 489.4, (0.215, 0.0118, 0.4307), 955.6, 25.0)
"""Default home of PX4's SIH."""

_FIRMWARE_VERSIONS: dict[Px4Release, int] = {
    "1.14": 0x010E04FF,
    "1.15": 0x010F04FF,
    "1.16": 0x011001FF,
    "1.17": 0x011100FF,
    "1.18": 0x01120080,  # beta
}
CAPABILITIES = 0xE8FF

_SENSORS_PRESENT, _SENSORS_ENABLED, _SENSORS_HEALTHY = 0x200C02F, 0x201C02F, 0x320C83F
_ESTIMATOR_WITHOUT_POSITION = 0xE5
_ESTIMATOR_WITH_POSITION, _ESTIMATOR_ON_GROUND = 0x37F, 0x3FF
_STATE_UNINIT, _STATE_STANDBY, _STATE_ACTIVE = 0, 3, 4
_STATE_CRITICAL = 5
_ODOMETRY_COVARIANCE = [math.nan, *[0.0] * 20]


class HandPacked(mav.MAVLink_message):  # type: ignore[misc]  # the library has no types
    """Message that the dialect lacks, given by number, payload and CRC seed."""

    def __init__(self, number: int, name: str, payload: bytes, crc_extra: int) -> None:
        super().__init__(number, name)
        self._hand_packed = payload
        self._hand_crc_extra = crc_extra

    def pack(self, sender: Message, force_mavlink1: bool = False) -> bytes:
        packed = self._pack(sender, self._hand_crc_extra, self._hand_packed, force_mavlink1)
        return bytes(packed)


def event_message(event: Event, sequence: int) -> Message:
    arguments = event.arguments.ljust(EVENT_ARGUMENT_BYTES, b"\0")
    payload = _EVENT.pack(event.number, event.uptime_ms, sequence, 0, 0, event.levels, arguments)
    return HandPacked(EVENT, "EVENT", payload, EVENT_CRC_EXTRA)


def _current_mode(ap: Px4) -> Message:
    mode, intended = ap.mode, ap.commander.intended
    payload = _CURRENT_MODE.pack(mode.custom_mode, intended.custom_mode, mode.standard)
    return HandPacked(CURRENT_MODE, "CURRENT_MODE", payload, CURRENT_MODE_CRC_EXTRA)


def _heartbeat(ap: Px4) -> Message:
    """Build HEARTBEAT; once a second, so a short change, even an arming, may never show."""
    flags = ap.mode.base_flags
    if ap.mode is Px4Mode.OFFBOARD and isinstance(ap.setpoint, PositionSetpoint):
        flags |= mav.MAV_MODE_FLAG_STABILIZE_ENABLED
    if ap.armed:
        flags |= mav.MAV_MODE_FLAG_SAFETY_ARMED
    if ap.in_failsafe:
        status = _STATE_CRITICAL
    elif ap.armed:
        status = _STATE_ACTIVE
    else:
        status = _STATE_STANDBY if ap.commander.can_arm() else _STATE_UNINIT
    return mav.MAVLink_heartbeat_message(
        ap.config.vehicle_type, mav.MAV_AUTOPILOT_PX4, flags, ap.mode.custom_mode, status, 3
    )


def _sys_status(ap: Px4) -> Message:
    """Build SYS_STATUS; PREARM_CHECK, never present, is healthy if health allows arming."""
    sticks = mav.MAV_SYS_STATUS_SENSOR_RC_RECEIVER if ap.stick_input.valid else 0
    healthy = _SENSORS_HEALTHY | sticks
    if ap.armed or ap.commander.can_arm():
        healthy |= mav.MAV_SYS_STATUS_PREARM_CHECK
    present, enabled = _SENSORS_PRESENT | sticks, _SENSORS_ENABLED
    return sys_status(ap, present=present, enabled=enabled, healthy=healthy)


def _gps_raw_int(ap: Px4) -> Message:
    fix = mav.GPS_FIX_TYPE_NO_FIX if ap.position_lost else mav.GPS_FIX_TYPE_3D_FIX
    return HOME.gps_raw_int(ap, fix=fix, eph=70, epv=110)


def _local_position_ned(ap: Px4) -> Message:
    """Build LOCAL_POSITION_NED; without a position, zeros that nothing marks as invalid."""
    (north, east, down), (vn, ve, vd) = ap.sensed.position_ned_m, ap.sensed.velocity_ned_mps
    if not ap.position_ready:
        north = east = vn = ve = 0.0
    return mav.MAVLink_local_position_ned_message(boot_ms(ap), north, east, down, vn, ve, vd)


def _odometry(ap: Px4) -> Message:
    body = ap.sensed
    velocity = rotate(conjugate(body.ned_from_body_wxyz), body.velocity_ned_mps)
    return mav.MAVLink_odometry_message(
        boot_us(ap),
        mav.MAV_FRAME_LOCAL_NED,
        mav.MAV_FRAME_BODY_FRD,
        *body.position_ned_m,
        list(body.ned_from_body_wxyz),
        *velocity,
        *body.rate_body_radps,
        _ODOMETRY_COVARIANCE,
        _ODOMETRY_COVARIANCE,
        0,
        mav.MAV_ESTIMATOR_TYPE_AUTOPILOT,
        100,
    )


def _rc_channels(ap: Px4) -> Message | None:
    """Build RC_CHANNELS from a receiver's channels; MANUAL_CONTROL never shows here."""
    if ap.receiver_us is None:
        return None
    channels = (*ap.receiver_us, *[65535] * 18)[:18]
    return mav.MAVLink_rc_channels_message(boot_ms(ap), len(ap.receiver_us), *channels, 100)


def _manual_control(ap: Px4) -> Message | None:
    """Build MANUAL_CONTROL: the chosen sticks, scaled in single precision and truncated."""
    if not ap.stick_input.valid:
        return None
    forward, right, throttle, yaw = (np.float32(value) for value in ap.stick_input.sticks)
    thousand, one, two = np.float32(1000.0), np.float32(1.0), np.float32(2.0)
    x, y, r = (int(value * thousand) for value in (forward, right, yaw))
    z = int((throttle + one) / two * thousand)
    return mav.MAVLink_manual_control_message(ap.system_id, x, y, z, r, 0)


def _vfr_hud(ap: Px4) -> Message:
    altitude_m = HOME.alt_m - ap.sensed.position_ned_m[2]
    return vfr_hud(ap, altitude_m=altitude_m, throttle=ap.flight.thrust if ap.armed else 0.0)


def _attitude_target(ap: Px4) -> Message:
    """Build ATTITUDE_TARGET: setpoints of the rate and attitude loops, in any mode."""
    flight = ap.flight
    return mav.MAVLink_attitude_target_message(
        boot_ms(ap), 0, list(flight.attitude), *flight.rates_radps, flight.thrust
    )


def _position_target(ap: Px4) -> Message:
    none, flight = [math.nan] * 3, ap.flight
    turn = (math.nan, flight.yaw_rate_radps)
    return mav.MAVLink_position_target_local_ned_message(
        boot_ms(ap), mav.MAV_FRAME_LOCAL_NED, 0, *none, *flight.velocity_ned_mps, *none, *turn
    )


def _estimator_status(ap: Px4) -> Message:
    """Build ESTIMATOR_STATUS, the only message with the validity of the horizontal position."""
    flags = _ESTIMATOR_ON_GROUND if ap.landed else _ESTIMATOR_WITH_POSITION
    if not ap.position_ready:
        flags = _ESTIMATOR_WITHOUT_POSITION
    if not ap.estimator_ready:
        flags = 0
    return mav.MAVLink_estimator_status_message(
        boot_us(ap), flags, 0.02, 0.02, 0.02, 0.02, 0.0, 0.0, 0.2, 0.2
    )


def _extended_sys_state(ap: Px4) -> Message:
    is_landing, is_taking_off = ap.mode is Px4Mode.AUTO_LAND, ap.mode is Px4Mode.AUTO_TAKEOFF
    vtol = mav.MAV_VTOL_STATE_MC
    return extended_sys_state(ap, vtol, is_landing=is_landing, is_taking_off=is_taking_off)


BUILDERS: dict[int, Callable[[Px4], Message | None]] = {
    **HOME.builders(
        gyro=lambda ap: ap.sensed.rate_body_radps,
        field_per_gauss=1.0,
        has_pressure_difference=False,
        version=lambda ap: _FIRMWARE_VERSIONS[ap.config.px4_release],
        capabilities=CAPABILITIES,
        energy_hj=-1,
    ),
    mav.MAVLINK_MSG_ID_HEARTBEAT: _heartbeat,
    mav.MAVLINK_MSG_ID_SYS_STATUS: _sys_status,
    mav.MAVLINK_MSG_ID_GPS_RAW_INT: _gps_raw_int,
    mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED: _local_position_ned,
    mav.MAVLINK_MSG_ID_RC_CHANNELS: _rc_channels,
    mav.MAVLINK_MSG_ID_MANUAL_CONTROL: _manual_control,
    mav.MAVLINK_MSG_ID_VFR_HUD: _vfr_hud,
    mav.MAVLINK_MSG_ID_ATTITUDE_TARGET: _attitude_target,
    mav.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED: _position_target,
    # The vehicle's request; the peer's answer needs no action.
    mav.MAVLINK_MSG_ID_TIMESYNC: lambda ap: mav.MAVLink_timesync_message(0, ap.uptime_ns),
    mav.MAVLINK_MSG_ID_ESTIMATOR_STATUS: _estimator_status,
    mav.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: _extended_sys_state,
    mav.MAVLINK_MSG_ID_ODOMETRY: _odometry,
    CURRENT_MODE: _current_mode,
}
"""Builders of all messages to stream or request; they return None with nothing to report."""
BUILDERS_1_14 = {key: build for key, build in BUILDERS.items() if key != CURRENT_MODE}
"""Builders without CURRENT_MODE, which came with 1.15 (upstream commit bb900264e0)."""

_SLOW_TOPICS = (
    mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
    mav.MAVLINK_MSG_ID_ODOMETRY,
    mav.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
    mav.MAVLINK_MSG_ID_ESTIMATOR_STATUS,
)


def topic_version(message_id: int, ap: Px4) -> Hashable:
    """Return a value that changes with each new sample of the topic; it bounds a stream's rate."""
    if message_id in _SLOW_TOPICS:
        return _at_rate(ap, 8)
    if message_id == mav.MAVLINK_MSG_ID_ATTITUDE_TARGET:
        sends_attitude = ap.mode is Px4Mode.OFFBOARD and not isinstance(
            ap.setpoint, PositionSetpoint
        )
        return ap.setpoint_count if sends_attitude else _at_rate(ap, 8)
    if message_id == mav.MAVLINK_MSG_ID_MANUAL_CONTROL:
        return ap.stick_input.count
    if message_id == mav.MAVLINK_MSG_ID_GPS_RAW_INT:
        return _at_rate(ap, 125)
    if message_id == CURRENT_MODE:
        return ap.mode, ap.commander.intended, _at_rate(ap, 500)
    return ap.uptime_ns


def _at_rate(ap: Px4, period_ms: int) -> int:
    """Return the version of a topic that is published with this period."""
    return ap.uptime_ns // (period_ms * NS_PER_MS)
