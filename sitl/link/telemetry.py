"""Messages common to both firmwares, from the state of the vehicle."""

import math
from typing import Any, ClassVar, Generic, TypeAlias, TypeVar

from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.vehicle.firmware import Autopilot
from sitl.vehicle.rotation import to_euler

Message: TypeAlias = Any  # a pymavlink message (the library has no types)
Fields: TypeAlias = tuple[Any, ...]
Ap = TypeVar("Ap", bound=Autopilot)

METRES_PER_DEGREE = 111_319.5
FULL_PERCENT = 100  # of the battery, which never empties
INT16 = 32767
_IMU_FIELDS_UPDATED = 0x3F


def flags(prefix: str, names: str) -> int:
    """Return the sum of the dialect's constants with this prefix."""
    return sum(int(getattr(mav, prefix + name)) for name in names.split())


class Telemetry(Generic[Ap]):
    """Messages that can be streamed or requested, of one boot.

    A method with the name of a message returns its fields, or None while there is nothing to
    report.
    """

    names: dict[int, str]
    """Methods by the number of their message."""
    dialect: ClassVar[Any] = mav  # with all of these messages
    lat_deg: ClassVar[float]  # of the simulator's origin
    lon_deg: ClassVar[float]
    alt_m: ClassVar[float]  # above mean sea level
    capabilities: ClassVar[int]  # MAV_PROTOCOL_CAPABILITY

    def __init__(self, ap: Ap) -> None:
        self.ap = ap

    def __init_subclass__(cls) -> None:
        kinds = {name: getattr(cls.dialect, f"MAVLink_{name}_message", None) for name in dir(cls)}
        cls.names = {kind.id: name for name, kind in kinds.items() if kind}

    def build(self, number: int) -> Message | None:
        """Return the message of this number, which must be known; None: nothing to report."""
        fields = getattr(self, self.names[number])()
        kind = getattr(self.dialect, f"MAVLink_{self.names[number]}_message")
        return None if fields is None else kind(*fields)

    @property
    def version(self) -> int:
        """Version of the firmware, for AUTOPILOT_VERSION."""
        raise NotImplementedError

    @property
    def boot_ms(self) -> int:
        """Time since boot in whole milliseconds, a uint32 that wraps after 49.7 days."""
        return self.ap.uptime_ns // 1_000_000 % 2**32

    @property
    def boot_us(self) -> int:
        return self.ap.uptime_ns // 1_000

    def attitude(self) -> Fields:
        body = self.ap.sensed
        return (self.boot_ms, *to_euler(body.ned_from_body_wxyz), *body.rate_body_radps)

    def attitude_quaternion(self) -> Fields:
        body = self.ap.sensed
        return (self.boot_ms, *body.ned_from_body_wxyz, *body.rate_body_radps)

    def global_position_int(self) -> Fields | None:
        if not self.ap.position_ready:
            return None
        north, east, down = self.ap.sensed.position_ned_m
        lat = self.lat_deg + north / METRES_PER_DEGREE
        lon = self.lon_deg + east / (METRES_PER_DEGREE * math.cos(math.radians(self.lat_deg)))
        heights_mm = (round(1000.0 * (self.alt_m - down)), round(-1000.0 * down))
        scaled = (round(100.0 * speed) for speed in self.ap.sensed.velocity_ned_mps)
        velocity_cmps = (max(-INT16, min(INT16, cmps)) for cmps in scaled)
        nose_cdeg = round(math.degrees(self.ap.yaw_rad) % 360.0 * 100.0) % 36000
        place = (round(lat * 1e7), round(lon * 1e7), *heights_mm)
        return (self.boot_ms, *place, *velocity_cmps, nose_cdeg)

    def highres_imu(self) -> Fields:
        """Accelerometer and gyro; without a magnetometer and a barometer."""
        body, none = self.ap.sensed, [0.0] * 7
        imu = (*body.specific_force_body_mps2, *body.rate_body_radps)
        return (self.boot_us, *imu, *none, _IMU_FIELDS_UPDATED, 0)

    def autopilot_version(self) -> Fields:
        return (self.capabilities, self.version, 0, 0, 0, *[[0] * 8] * 3, 0, 0, self.ap.system_id)

    def _health(self, *, present: int, enabled: int, healthy: int) -> Fields:
        """Return the fields of SYS_STATUS with these sensors and the battery."""
        battery = (self.ap.battery_mv, 0, FULL_PERCENT)
        return (present, enabled, healthy, 100, *battery, 0, 0, 0, 0, 0, 0)

    def _landed_state(self, *, is_landing: bool, is_taking_off: bool) -> int:
        if self.ap.landed:
            return int(mav.MAV_LANDED_STATE_ON_GROUND)
        if is_landing:
            return int(mav.MAV_LANDED_STATE_LANDING)
        return int(mav.MAV_LANDED_STATE_TAKEOFF if is_taking_off else mav.MAV_LANDED_STATE_IN_AIR)
