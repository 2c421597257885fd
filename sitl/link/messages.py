"""Telemetry: one small function a message, from the autopilot's state to MAVLink's units.

Units and oddities are those measured on ArduCopter 4.7: scaled integers in RAW_IMU, a HIGHRES_IMU
whose gyro keeps its bias and whose magnetometer is a million times too large, positions that are
withheld until the estimator has one. A function that returns None has nothing to say yet.
"""

import math
from collections.abc import Callable
from typing import Any, TypeAlias

from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.rotation import Vec3, conjugate, rotate, to_euler
from sitl.vehicle.autopilot import Autopilot
from sitl.vehicle.dynamics import GRAVITY_MPS2
from sitl.vehicle.flight_modes import Mode

Message: TypeAlias = Any
"""A pymavlink message (the library has no types)."""

HOME_LAT_DEG, HOME_LON_DEG, HOME_ALT_M = -35.3632621, 149.1652374, 584.0
"""ArduPilot SITL's usual field."""
METRES_PER_DEGREE = 111_319.5
EARTH_FIELD_GAUSS: Vec3 = (0.2322, 0.0520, -0.5280)
GYRO_BIAS_RADPS: Vec3 = (0.003, -0.002, 0.001)
"""What the estimator subtracts; raw IMU messages still carry it."""
GROUND_PRESSURE_HPA = 945.0
TEMPERATURE_CDEG = 3500
BATTERY_MV, BATTERY_CA = 12_600, 0

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
)
"""No FTP: clients then fetch parameters with PARAM_REQUEST_LIST."""
_FIRMWARE_VERSION = 4 << 24 | 7 << 16 | 0 << 8 | mav.FIRMWARE_VERSION_TYPE_DEV
_IMU_FIELDS_UPDATED = 8191
_INT16 = 32767


def _ms(ap: Autopilot) -> int:
    return ap.uptime_ns // 1_000_000


def _us(ap: Autopilot) -> int:
    return ap.uptime_ns // 1_000


def _int16(value: float) -> int:
    return max(-_INT16, min(_INT16, round(value)))


def _raw_gyro(ap: Autopilot) -> tuple[float, ...]:
    return tuple(
        rate + bias for rate, bias in zip(ap.sensed.rate_body_radps, GYRO_BIAS_RADPS, strict=True)
    )


def _mag_gauss(ap: Autopilot) -> Vec3:
    return rotate(conjugate(ap.sensed.ned_from_body_wxyz), EARTH_FIELD_GAUSS)


def _lat_lon_e7(north_m: float, east_m: float) -> tuple[int, int]:
    lat = HOME_LAT_DEG + north_m / METRES_PER_DEGREE
    lon = HOME_LON_DEG + east_m / (METRES_PER_DEGREE * math.cos(math.radians(HOME_LAT_DEG)))
    return round(lat * 1e7), round(lon * 1e7)


def heartbeat(ap: Autopilot) -> Message:
    """HEARTBEAT of a quadrotor; CRITICAL while a failsafe is active."""
    base_mode = (
        mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        | mav.MAV_MODE_FLAG_STABILIZE_ENABLED
        | mav.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED
    )
    status = mav.MAV_STATE_STANDBY
    if ap.armed:
        base_mode |= mav.MAV_MODE_FLAG_SAFETY_ARMED
        status = mav.MAV_STATE_ACTIVE
    if ap.radio_failsafe.active or ap.gcs_failsafe.active:
        status = mav.MAV_STATE_CRITICAL
    return mav.MAVLink_heartbeat_message(
        mav.MAV_TYPE_QUADROTOR,
        mav.MAV_AUTOPILOT_ARDUPILOTMEGA,
        base_mode,
        int(ap.mode),
        status,
        3,
    )


def attitude(ap: Autopilot) -> Message:
    """ATTITUDE: radians, bias-corrected rates."""
    angles = to_euler(ap.sensed.ned_from_body_wxyz)
    return mav.MAVLink_attitude_message(_ms(ap), *angles, *ap.sensed.rate_body_radps)


def attitude_quaternion(ap: Autopilot) -> Message:
    """ATTITUDE_QUATERNION: w, x, y, z of NED from body."""
    return mav.MAVLink_attitude_quaternion_message(
        _ms(ap), *ap.sensed.ned_from_body_wxyz, *ap.sensed.rate_body_radps
    )


def local_position_ned(ap: Autopilot) -> Message | None:
    """LOCAL_POSITION_NED; nothing before the estimator has a position."""
    if not ap.position_ready:
        return None
    return mav.MAVLink_local_position_ned_message(
        _ms(ap), *ap.sensed.position_ned_m, *ap.sensed.velocity_ned_mps
    )


def global_position_int(ap: Autopilot) -> Message | None:
    """GLOBAL_POSITION_INT, relative to the same home."""
    if not ap.position_ready:
        return None
    north, east, down = ap.sensed.position_ned_m
    velocity_cm = (_int16(100.0 * v) for v in ap.sensed.velocity_ned_mps)
    _, _, yaw = to_euler(ap.sensed.ned_from_body_wxyz)
    return mav.MAVLink_global_position_int_message(
        _ms(ap),
        *_lat_lon_e7(north, east),
        round(1000.0 * (HOME_ALT_M - down)),
        round(-1000.0 * down),
        *velocity_cm,
        round(math.degrees(yaw) % 360.0 * 100.0) % 36000,
    )


def _scaled_imu_fields(ap: Autopilot) -> tuple[int, ...]:
    """Acceleration in milli-g, gyro in mrad/s, field in mGauss."""
    accel = (_int16(1000.0 * f / GRAVITY_MPS2) for f in ap.sensed.specific_force_body_mps2)
    gyro = (_int16(1000.0 * rate) for rate in _raw_gyro(ap))
    field = (_int16(1000.0 * b) for b in _mag_gauss(ap))
    return (*accel, *gyro, *field)


def raw_imu(ap: Autopilot) -> Message:
    """RAW_IMU: scaled integers in spite of its name."""
    return mav.MAVLink_raw_imu_message(_us(ap), *_scaled_imu_fields(ap), 0, TEMPERATURE_CDEG)


def scaled_imu(ap: Autopilot) -> Message:
    """SCALED_IMU of the first IMU."""
    return mav.MAVLink_scaled_imu_message(_ms(ap), *_scaled_imu_fields(ap), TEMPERATURE_CDEG)


def scaled_imu2(ap: Autopilot) -> Message:
    """SCALED_IMU2: the second IMU agrees with the first."""
    return mav.MAVLink_scaled_imu2_message(_ms(ap), *_scaled_imu_fields(ap), TEMPERATURE_CDEG)


def highres_imu(ap: Autopilot) -> Message:
    """HIGHRES_IMU: m/s^2, rad/s with bias; the field is in micro-gauss, as the firmware has it."""
    height = -ap.sensed.position_ned_m[2]
    pressure = GROUND_PRESSURE_HPA * math.exp(-height / 8434.0)
    return mav.MAVLink_highres_imu_message(
        _us(ap),
        *ap.sensed.specific_force_body_mps2,
        *_raw_gyro(ap),
        *(1e6 * b for b in _mag_gauss(ap)),
        pressure,
        pressure - GROUND_PRESSURE_HPA,
        HOME_ALT_M + height,
        TEMPERATURE_CDEG / 100.0,
        _IMU_FIELDS_UPDATED,
        0,
    )


def rc_channels(ap: Autopilot) -> Message:
    """RC_CHANNELS: the values after overrides."""
    return mav.MAVLink_rc_channels_message(_ms(ap), 8, *ap.rc.channels_us, 0, 0, 255)


def servo_output_raw(ap: Autopilot) -> Message:
    """SERVO_OUTPUT_RAW: motors at 1000..2000 us."""
    motors = (round(1000.0 + 1000.0 * m) for m in ap.motor_commands)
    return mav.MAVLink_servo_output_raw_message(_us(ap) & 0xFFFFFFFF, 0, *motors, 0, 0, 0, 0)


def vfr_hud(ap: Autopilot) -> Message:
    """VFR_HUD."""
    north, east, down = ap.sensed.velocity_ned_mps
    speed = math.hypot(north, east)
    _, _, yaw = to_euler(ap.sensed.ned_from_body_wxyz)
    throttle = round(100.0 * sum(ap.motor_commands) / len(ap.motor_commands))
    return mav.MAVLink_vfr_hud_message(
        speed,
        speed,
        round(math.degrees(yaw) % 360.0) % 360,
        throttle,
        HOME_ALT_M - ap.sensed.position_ned_m[2],
        -down,
    )


def sys_status(ap: Autopilot) -> Message:
    """SYS_STATUS; PREARM_CHECK is healthy when mode and sticks alone decide on arming."""
    present = _SENSORS | mav.MAV_SYS_STATUS_PREARM_CHECK
    health = _SENSORS
    if ap.armed or ap.prearm_refusal() is None:
        health |= mav.MAV_SYS_STATUS_PREARM_CHECK
    return mav.MAVLink_sys_status_message(
        present, present, health, 100, BATTERY_MV, BATTERY_CA, 100, 0, 0, 0, 0, 0, 0
    )


def ekf_status_report(ap: Autopilot) -> Message:
    """EKF_STATUS_REPORT: attitude from the start, the rest with a position."""
    flags = mav.EKF_UNINITIALIZED
    if ap.estimator_ready:
        flags = mav.EKF_ATTITUDE | mav.EKF_VELOCITY_VERT | mav.EKF_POS_VERT_ABS
        if not ap.position_ready:
            flags |= mav.EKF_CONST_POS_MODE
    if ap.position_ready:
        flags |= (
            mav.EKF_VELOCITY_HORIZ
            | mav.EKF_POS_HORIZ_REL
            | mav.EKF_POS_HORIZ_ABS
            | mav.EKF_PRED_POS_HORIZ_REL
            | mav.EKF_PRED_POS_HORIZ_ABS
        )
    return mav.MAVLink_ekf_status_report_message(flags, 0.01, 0.01, 0.01, 0.01, 0.0)


def gps_raw_int(ap: Autopilot) -> Message:
    """GPS_RAW_INT: the last 5 Hz fix, repeated."""
    north, east, down = ap.gps.position_ned_m
    vn, ve, _ = ap.gps.velocity_ned_mps
    course_cdeg = round(math.degrees(math.atan2(ve, vn)) % 360.0 * 100.0) % 36000
    return mav.MAVLink_gps_raw_int_message(
        _us(ap),
        mav.GPS_FIX_TYPE_3D_FIX,
        *_lat_lon_e7(north, east),
        round(1000.0 * (HOME_ALT_M - down)),
        121,
        200,
        round(100.0 * math.hypot(vn, ve)),
        course_cdeg,
        10,
    )


def battery_status(ap: Autopilot) -> Message:
    """BATTERY_STATUS: a full pack that never empties."""
    return mav.MAVLink_battery_status_message(
        0,
        mav.MAV_BATTERY_FUNCTION_ALL,
        mav.MAV_BATTERY_TYPE_LIPO,
        _INT16,
        [BATTERY_MV] + [65535] * 9,
        BATTERY_CA,
        0,
        0,
        100,
    )


def extended_sys_state(ap: Autopilot) -> Message:
    """EXTENDED_SYS_STATE."""
    if ap.landed:
        state = mav.MAV_LANDED_STATE_ON_GROUND
    elif ap.mode in (Mode.LAND, Mode.RTL):
        state = mav.MAV_LANDED_STATE_LANDING
    else:
        state = mav.MAV_LANDED_STATE_IN_AIR
    return mav.MAVLink_extended_sys_state_message(mav.MAV_VTOL_STATE_UNDEFINED, state)


def home_position(ap: Autopilot) -> Message | None:
    """HOME_POSITION: where it started."""
    if not ap.position_ready:
        return None
    lat, lon = _lat_lon_e7(0.0, 0.0)
    return mav.MAVLink_home_position_message(
        lat, lon, round(HOME_ALT_M * 1000.0), 0.0, 0.0, 0.0, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0
    )


def system_time(ap: Autopilot) -> Message:
    """SYSTEM_TIME; no date, since the vehicle has no wall clock."""
    return mav.MAVLink_system_time_message(0, _ms(ap))


def autopilot_version(ap: Autopilot) -> Message:
    """AUTOPILOT_VERSION 4.7.0-dev."""
    unique = ap.params.integer("MAV_SYSID")
    no_hash = [0] * 8
    return mav.MAVLink_autopilot_version_message(
        _CAPABILITIES, _FIRMWARE_VERSION, 0, 0, 0, no_hash, no_hash, no_hash, 0, 0, unique
    )


def _nothing(_ap: Autopilot) -> Message | None:
    """Accepted by the firmware, never sent."""
    return None


BUILDERS: dict[int, Callable[[Autopilot], Message | None]] = {
    mav.MAVLINK_MSG_ID_HEARTBEAT: heartbeat,
    mav.MAVLINK_MSG_ID_SYS_STATUS: sys_status,
    mav.MAVLINK_MSG_ID_SYSTEM_TIME: system_time,
    mav.MAVLINK_MSG_ID_GPS_RAW_INT: gps_raw_int,
    mav.MAVLINK_MSG_ID_SCALED_IMU: scaled_imu,
    mav.MAVLINK_MSG_ID_RAW_IMU: raw_imu,
    mav.MAVLINK_MSG_ID_ATTITUDE: attitude,
    mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: attitude_quaternion,
    mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED: local_position_ned,
    mav.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: global_position_int,
    mav.MAVLINK_MSG_ID_RC_CHANNELS_RAW: _nothing,
    mav.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW: servo_output_raw,
    mav.MAVLINK_MSG_ID_RC_CHANNELS: rc_channels,
    mav.MAVLINK_MSG_ID_VFR_HUD: vfr_hud,
    mav.MAVLINK_MSG_ID_OPTICAL_FLOW: _nothing,
    mav.MAVLINK_MSG_ID_HIGHRES_IMU: highres_imu,
    mav.MAVLINK_MSG_ID_SCALED_IMU2: scaled_imu2,
    mav.MAVLINK_MSG_ID_BATTERY_STATUS: battery_status,
    mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION: autopilot_version,
    mav.MAVLINK_MSG_ID_EKF_STATUS_REPORT: ekf_status_report,
    mav.MAVLINK_MSG_ID_HOME_POSITION: home_position,
    mav.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: extended_sys_state,
}
"""Every message that can be streamed or requested."""
