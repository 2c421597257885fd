"""Units and messages common to both firmwares, from the state of the vehicle."""

import math
from collections.abc import Callable, Iterable
from typing import NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.link.server import Message
from sitl.vehicle.dynamics import GRAVITY_MPS2
from sitl.vehicle.firmware import Autopilot
from sitl.vehicle.rotation import Vec3, conjugate, rotate, to_euler

METRES_PER_DEGREE = 111_319.5
FULL_PERCENT = 100  # of the battery
INT16 = 32767
_IMU_FIELDS_UPDATED = 0x1FFF


class Home(NamedTuple):
    """Location of the simulator's origin, and the messages that depend on it."""

    lat_deg: float
    lon_deg: float
    alt_m: float  # above mean sea level
    field_ned_gauss: Vec3  # magnetic field of the earth
    pressure_hpa: float  # air pressure at this altitude
    temperature_c: float

    def lat_lon_e7(self, north_m: float, east_m: float) -> tuple[int, int]:
        """Return latitude and longitude in 1e-7 degrees."""
        lat = self.lat_deg + north_m / METRES_PER_DEGREE
        lon = self.lon_deg + east_m / (METRES_PER_DEGREE * math.cos(math.radians(self.lat_deg)))
        return round(lat * 1e7), round(lon * 1e7)

    def _mag_gauss(self, ap: Autopilot) -> Vec3:
        """Return the magnetic field in body axes."""
        return rotate(conjugate(ap.sensed.ned_from_body_wxyz), self.field_ned_gauss)

    def _global_position_int(self, ap: Autopilot) -> Message | None:
        """Build GLOBAL_POSITION_INT; None without a position."""
        if not ap.position_ready:
            return None
        north, east, down = ap.sensed.position_ned_m
        return mav.MAVLink_global_position_int_message(
            boot_ms(ap),
            *self.lat_lon_e7(north, east),
            round(1000.0 * (self.alt_m - down)),
            round(-1000.0 * down),
            *int16(ap.sensed.velocity_ned_mps, 100.0),
            heading(ap.yaw_rad, 100.0),
        )

    def _home_position(self, ap: Autopilot) -> Message | None:
        """Build HOME_POSITION; None without a position."""
        if not ap.position_ready:
            return None
        altitude_mm, level = round(self.alt_m * 1000.0), [1.0, 0.0, 0.0, 0.0]
        return mav.MAVLink_home_position_message(
            *self.lat_lon_e7(0.0, 0.0), altitude_mm, 0.0, 0.0, 0.0, level, 0.0, 0.0, 0.0
        )

    def gps_raw_int(self, ap: Autopilot, *, fix: int, eph: int, epv: int) -> Message:
        """Build GPS_RAW_INT: the last fix, repeated; accuracies and satellites are constant."""
        north, east, down = ap.gps.position_ned_m
        vn, ve, _ = ap.gps.velocity_ned_mps
        place = (*self.lat_lon_e7(north, east), round(1000.0 * (self.alt_m - down)))
        motion = (round(100.0 * math.hypot(vn, ve)), heading(math.atan2(ve, vn), 100.0))
        return mav.MAVLink_gps_raw_int_message(boot_us(ap), fix, *place, eph, epv, *motion, 10)

    def builders(
        self,
        *,
        gyro: Callable[[Autopilot], Vec3],
        field_per_gauss: float,
        has_pressure_difference: bool,
        version: Callable[[Autopilot], int],
        capabilities: int,
        energy_hj: int,
    ) -> dict[int, Callable[[Autopilot], Message | None]]:
        """Return the builders of messages of both firmwares, by message number.

        HIGHRES_IMU has the gyro in rad/s, the field in the firmware's unit, and the pressure
        relative to the origin with ``has_pressure_difference``, else 0. SCALED_IMU has milli-g,
        mrad/s and mGauss. ``energy_hj`` -1: not known.
        """

        def highres_imu(ap: Autopilot) -> Message:
            height_m = -ap.sensed.position_ned_m[2]
            pressure = self.pressure_hpa * math.exp(-height_m / 8434.0)
            difference = pressure - self.pressure_hpa if has_pressure_difference else 0.0
            air = (pressure, difference, self.alt_m + height_m, self.temperature_c)
            field = (field_per_gauss * gauss for gauss in self._mag_gauss(ap))
            imu = (*ap.sensed.specific_force_body_mps2, *gyro(ap), *field)
            return mav.MAVLink_highres_imu_message(boot_us(ap), *imu, *air, _IMU_FIELDS_UPDATED, 0)

        return {
            # No date: the vehicle has no wall clock.
            mav.MAVLINK_MSG_ID_SYSTEM_TIME: lambda ap: mav.MAVLink_system_time_message(
                0, boot_ms(ap)
            ),
            mav.MAVLINK_MSG_ID_ATTITUDE: lambda ap: mav.MAVLink_attitude_message(
                boot_ms(ap), *to_euler(ap.sensed.ned_from_body_wxyz), *ap.sensed.rate_body_radps
            ),
            mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: lambda ap: (
                mav.MAVLink_attitude_quaternion_message(
                    boot_ms(ap), *ap.sensed.ned_from_body_wxyz, *ap.sensed.rate_body_radps
                )
            ),
            mav.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: self._global_position_int,
            mav.MAVLINK_MSG_ID_HOME_POSITION: self._home_position,
            mav.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW: servo_output_raw,
            mav.MAVLINK_MSG_ID_SCALED_IMU: lambda ap: mav.MAVLink_scaled_imu_message(
                boot_ms(ap), *self.scaled_imu(ap, gyro(ap))
            ),
            mav.MAVLINK_MSG_ID_HIGHRES_IMU: highres_imu,
            mav.MAVLINK_MSG_ID_BATTERY_STATUS: lambda ap: battery_status(ap, energy_hj=energy_hj),
            mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION: lambda ap: mav.MAVLink_autopilot_version_message(
                capabilities, version(ap), 0, 0, 0, *[[0] * 8] * 3, 0, 0, ap.system_id
            ),
        }

    def scaled_imu(self, ap: Autopilot, gyro_radps: Iterable[float]) -> tuple[int, ...]:
        """Return acceleration, gyro, field and temperature of SCALED_IMU."""
        accel = [1000.0 * force / GRAVITY_MPS2 for force in ap.sensed.specific_force_body_mps2]
        field = int16(self._mag_gauss(ap), 1000.0)
        temperature_cdeg = round(100.0 * self.temperature_c)
        return (*int16(accel, 1.0), *int16(gyro_radps, 1000.0), *field, temperature_cdeg)


def boot_ms(ap: Autopilot) -> int:
    """Return the time since boot in whole milliseconds, a uint32 that wraps after 49.7 days."""
    return ap.uptime_ns // 1_000_000 % 2**32


def boot_us(ap: Autopilot) -> int:
    return ap.uptime_ns // 1_000


def int16(values: Iterable[float], scale: float) -> list[int]:
    """Scale, round and clamp values to a field of 16 bits."""
    return [max(-INT16, min(INT16, round(scale * value))) for value in values]


def heading(angle_rad: float, units_per_degree: float = 1.0) -> int:
    """Convert an angle to whole units from 0 to below a full turn."""
    full_turn = round(360 * units_per_degree)
    return round(math.degrees(angle_rad) % 360.0 * units_per_degree) % full_turn


def servo_output_raw(ap: Autopilot) -> Message:
    """Build SERVO_OUTPUT_RAW: motors at 1000..2000 us."""
    motors = (round(1000.0 + 1000.0 * m) for m in ap.motor_commands)
    return mav.MAVLink_servo_output_raw_message(boot_us(ap) & 0xFFFFFFFF, 0, *motors, 0, 0, 0, 0)


def vfr_hud(ap: Autopilot, *, altitude_m: float, throttle: float) -> Message:
    """Build VFR_HUD; ``throttle`` is a share of full."""
    north, east, down = ap.sensed.velocity_ned_mps
    speed, percent = math.hypot(north, east), round(100.0 * throttle)
    nose = heading(ap.yaw_rad)
    return mav.MAVLink_vfr_hud_message(speed, speed, nose, percent, altitude_m, -down)


def sys_status(ap: Autopilot, *, present: int, enabled: int, healthy: int) -> Message:
    """Build SYS_STATUS with these sensors and the battery."""
    battery = (ap.battery_mv, 0, FULL_PERCENT)
    return mav.MAVLink_sys_status_message(
        present, enabled, healthy, 100, *battery, 0, 0, 0, 0, 0, 0
    )


def battery_status(ap: Autopilot, *, energy_hj: int) -> Message:
    """Build BATTERY_STATUS: one pack, reported as one cell; ``energy_hj`` -1: not known."""
    kind = (mav.MAV_BATTERY_FUNCTION_ALL, mav.MAV_BATTERY_TYPE_LIPO)
    cells_mv, charge = [ap.battery_mv] + [65535] * 9, mav.MAV_BATTERY_CHARGE_STATE_OK
    return mav.MAVLink_battery_status_message(
        0, *kind, INT16, cells_mv, 0, 0, energy_hj, FULL_PERCENT, 0, charge
    )


def extended_sys_state(
    ap: Autopilot, vtol: int, *, is_landing: bool, is_taking_off: bool
) -> Message:
    state = mav.MAV_LANDED_STATE_IN_AIR
    if ap.landed:
        state = mav.MAV_LANDED_STATE_ON_GROUND
    elif is_landing:
        state = mav.MAV_LANDED_STATE_LANDING
    elif is_taking_off:
        state = mav.MAV_LANDED_STATE_TAKEOFF
    return mav.MAVLink_extended_sys_state_message(vtol, state)
