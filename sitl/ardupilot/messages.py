"""Telemetry: from the autopilot's state to MAVLink messages and their units.

Units and oddities are those measured on ArduCopter 4.7: scaled integers in RAW_IMU, a HIGHRES_IMU
whose gyro keeps its bias and whose magnetometer is a million times too large, positions that are
withheld until the estimator has one.
"""

from collections.abc import Callable

from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.ardupilot.autopilot import ArduCopter
from sitl.ardupilot.flight_modes import Mode
from sitl.ardupilot.guided import Submode
from sitl.link.endpoint import Message
from sitl.link.telemetry import (
    Home,
    autopilot_version,
    battery_status,
    boot_ms,
    boot_us,
    extended_sys_state,
    sys_status,
    vfr_hud,
)
from sitl.rotation import Vec3
from sitl.vehicle.config import ArduPilotRelease

HOME = Home(-35.3632621, 149.1652374, 584.0, (0.2322, 0.0520, -0.5280), 945.0, 35.0)
"""ArduPilot SITL's default home."""
GYRO_BIAS_RADPS: Vec3 = (0.003, -0.002, 0.001)
"""Subtracted by the estimator; raw IMU messages still carry it."""

_SENSORS = (
    mav.MAV_SYS_STATUS_SENSOR_3D_GYRO
    | mav.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    | mav.MAV_SYS_STATUS_SENSOR_3D_MAG
    | mav.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE
    | mav.MAV_SYS_STATUS_SENSOR_GPS
    | mav.MAV_SYS_STATUS_SENSOR_ANGULAR_RATE_CONTROL
    | mav.MAV_SYS_STATUS_SENSOR_ATTITUDE_STABILIZATION
    | mav.MAV_SYS_STATUS_AHRS
    | mav.MAV_SYS_STATUS_SENSOR_BATTERY
)
_CAPABILITIES = (
    mav.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
    | mav.MAV_PROTOCOL_CAPABILITY_MISSION_INT
    | mav.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | mav.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    | mav.MAV_PROTOCOL_CAPABILITY_SET_ATTITUDE_TARGET
    | mav.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
)
"""No FTP: clients then fetch parameters with PARAM_REQUEST_LIST."""
_FIRMWARE_VERSIONS: dict[ArduPilotRelease, int] = {
    "4.6": 4 << 24 | 6 << 16 | 3 << 8 | mav.FIRMWARE_VERSION_TYPE_OFFICIAL,
    "4.7-dev": 4 << 24 | 7 << 16 | mav.FIRMWARE_VERSION_TYPE_DEV,
    "4.7": 4 << 24 | 7 << 16 | mav.FIRMWARE_VERSION_TYPE_OFFICIAL,
}
_EKF_VERTICAL = mav.EKF_ATTITUDE | mav.EKF_VELOCITY_VERT | mav.EKF_POS_VERT_ABS
_EKF_HORIZONTAL = (
    mav.EKF_VELOCITY_HORIZ
    | mav.EKF_POS_HORIZ_REL
    | mav.EKF_POS_HORIZ_ABS
    | mav.EKF_PRED_POS_HORIZ_REL
    | mav.EKF_PRED_POS_HORIZ_ABS
)
_VELOCITY_ONLY = 3079  # POSITION_TARGET_LOCAL_NED.type_mask: all but velocity and acceleration
_POSITION_ONLY = 3576  # all but the position


def _raw_gyro(ap: ArduCopter) -> tuple[float, ...]:
    return tuple(
        rate + bias for rate, bias in zip(ap.sensed.rate_body_radps, GYRO_BIAS_RADPS, strict=True)
    )


def _heartbeat(ap: ArduCopter) -> Message:
    """CRITICAL while a failsafe is active."""
    base_mode = (
        mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        | mav.MAV_MODE_FLAG_STABILIZE_ENABLED
        | mav.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED
    )
    status = mav.MAV_STATE_STANDBY
    if ap.armed:
        base_mode |= mav.MAV_MODE_FLAG_SAFETY_ARMED
        status = mav.MAV_STATE_ACTIVE
    if ap.radio_failsafe.active or ap.gcs_failsafe.active or ap.battery.is_low:
        status = mav.MAV_STATE_CRITICAL
    autopilot = mav.MAV_AUTOPILOT_ARDUPILOTMEGA
    return mav.MAVLink_heartbeat_message(
        ap.config.vehicle_type, autopilot, base_mode, int(ap.mode), status, 3
    )


def _scaled_imu(ap: ArduCopter) -> tuple[int, ...]:
    return HOME.scaled_imu(ap, _raw_gyro(ap))


def _highres_imu(ap: ArduCopter) -> Message:
    """Rates with bias; the field is in micro-gauss, as the firmware has it."""
    field = (1e6 * b for b in HOME.mag_gauss(ap))
    return HOME.highres_imu(ap, _raw_gyro(ap), field, has_difference=True)


def _vfr_hud(ap: ArduCopter) -> Message:
    throttle = sum(ap.motor_commands) / len(ap.motor_commands)
    altitude_m = HOME.alt_m - ap.sensed.position_ned_m[2] if ap.has_gps else 0.0
    return vfr_hud(ap, altitude_m=altitude_m, throttle=throttle)


def _sys_status(ap: ArduCopter) -> Message:
    """PREARM_CHECK is healthy when mode and sticks alone decide on arming."""
    present = _SENSORS | mav.MAV_SYS_STATUS_PREARM_CHECK
    present |= mav.MAV_SYS_STATUS_SENSOR_RC_RECEIVER if ap.rc.found else 0
    faults = 0
    if not ap.armed and ap.prearm_refusal() is not None:
        faults |= mav.MAV_SYS_STATUS_PREARM_CHECK
    if ap.radio_failsafe.active:
        faults |= mav.MAV_SYS_STATUS_SENSOR_RC_RECEIVER
    if ap.battery.is_low:
        faults |= mav.MAV_SYS_STATUS_SENSOR_BATTERY
    return sys_status(ap, present=present, enabled=present, healthy=present & ~faults)


def _ekf_status_report(ap: ArduCopter) -> Message:
    """Attitude from the start, the rest with a position."""
    flags = mav.EKF_UNINITIALIZED
    if ap.estimator_ready:
        flags = _EKF_VERTICAL | (0 if ap.position_ready else mav.EKF_CONST_POS_MODE)
    if ap.position_ready:
        flags |= _EKF_HORIZONTAL
    return mav.MAVLink_ekf_status_report_message(flags, 0.01, 0.01, 0.01, 0.01, 0.0)


def _extended_sys_state(ap: ArduCopter) -> Message:
    is_taking_off = ap.guided is not None and ap.guided.is_taking_off(ap.sensed)
    vtol, is_landing = mav.MAV_VTOL_STATE_UNDEFINED, ap.mode.lands
    return extended_sys_state(ap, vtol, is_landing=is_landing, is_taking_off=is_taking_off)


def _autopilot_version(ap: ArduCopter) -> Message:
    version = _FIRMWARE_VERSIONS[ap.config.ardupilot_release]
    return autopilot_version(ap, capabilities=_CAPABILITIES, version=version)


def _attitude_target(ap: ArduCopter) -> Message:
    """The controller's shaped target, whatever was sent; thrust before the boost for a lean."""
    attitude, rate_radps = ap.control.target
    return mav.MAVLink_attitude_target_message(
        boot_ms(ap), 0, attitude, *rate_radps, ap.control.thrust
    )


def _position_target(ap: ArduCopter) -> Message | None:
    """The setpoint that GUIDED follows, in NED axes; nothing in other modes or for attitudes."""
    guided = ap.guided if ap.mode is Mode.GUIDED else None
    if guided is None or guided.submode is Submode.ATTITUDE:
        return None
    is_takeoff = guided.submode is Submode.TAKEOFF
    return mav.MAVLink_position_target_local_ned_message(
        boot_ms(ap),
        mav.MAV_FRAME_LOCAL_NED,
        _POSITION_ONLY if is_takeoff else _VELOCITY_ONLY,
        *(0.0, 0.0, 0.0),  # also during a takeoff, as the firmware has it
        *guided.velocity.velocity_ned_mps,
        *(0.0, 0.0, 0.0, 0.0, 0.0),
    )


BUILDERS: dict[int, Callable[[ArduCopter], Message | None]] = {
    **HOME.builders(),
    mav.MAVLINK_MSG_ID_HEARTBEAT: _heartbeat,
    mav.MAVLINK_MSG_ID_SYS_STATUS: _sys_status,
    mav.MAVLINK_MSG_ID_GPS_RAW_INT: lambda ap: HOME.gps_raw_int(
        ap, fix=mav.GPS_FIX_TYPE_3D_FIX, eph=121, epv=200
    ),
    mav.MAVLINK_MSG_ID_SCALED_IMU: lambda ap: mav.MAVLink_scaled_imu_message(
        boot_ms(ap), *_scaled_imu(ap), HOME.temperature_cdeg
    ),
    # Scaled integers in spite of its name.
    mav.MAVLINK_MSG_ID_RAW_IMU: lambda ap: mav.MAVLink_raw_imu_message(
        boot_us(ap), *_scaled_imu(ap), 0, HOME.temperature_cdeg
    ),
    mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED: lambda ap: (
        mav.MAVLink_local_position_ned_message(
            boot_ms(ap), *ap.sensed.position_ned_m, *ap.sensed.velocity_ned_mps
        )
        if ap.position_ready
        else None
    ),
    mav.MAVLINK_MSG_ID_RC_CHANNELS_RAW: lambda _: None,  # accepted by the firmware, never sent
    # The values after overrides.
    mav.MAVLINK_MSG_ID_RC_CHANNELS: lambda ap: mav.MAVLink_rc_channels_message(
        boot_ms(ap), ap.rc.channel_count, *ap.rc.channels_us, 0, 0, 255
    ),
    mav.MAVLINK_MSG_ID_VFR_HUD: _vfr_hud,
    mav.MAVLINK_MSG_ID_OPTICAL_FLOW: lambda _: None,  # accepted by the firmware, never sent
    mav.MAVLINK_MSG_ID_HIGHRES_IMU: _highres_imu,
    # The second IMU agrees with the first.
    mav.MAVLINK_MSG_ID_SCALED_IMU2: lambda ap: mav.MAVLink_scaled_imu2_message(
        boot_ms(ap), *_scaled_imu(ap), HOME.temperature_cdeg
    ),
    mav.MAVLINK_MSG_ID_BATTERY_STATUS: lambda ap: battery_status(ap, energy_hj=0),
    mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION: _autopilot_version,
    mav.MAVLINK_MSG_ID_EKF_STATUS_REPORT: _ekf_status_report,
    mav.MAVLINK_MSG_ID_ATTITUDE_TARGET: _attitude_target,
    mav.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED: _position_target,
    mav.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: _extended_sys_state,
}
"""Every message that can be streamed or requested; None where there is nothing to report yet."""
