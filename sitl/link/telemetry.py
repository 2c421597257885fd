"""Units and messages that both firmwares send alike, from the state of the vehicle."""

import math
from collections.abc import Iterable
from typing import NamedTuple, Protocol

from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.link.framing import Message
from sitl.rotation import Vec3, conjugate, rotate, to_euler
from sitl.vehicle.dynamics import BodyState

METRES_PER_DEGREE = 111_319.5
INT16 = 32767


class Sensing(Protocol):
    """The part of an autopilot that these messages tell of."""

    motor_commands: tuple[float, ...]
    sensed: BodyState

    @property
    def uptime_ns(self) -> int:
        """Time since boot."""
        ...

    @property
    def position_ready(self) -> bool:
        """There is a horizontal position."""
        ...


class Home(NamedTuple):
    """The place of the simulator's origin."""

    lat_deg: float
    lon_deg: float
    alt_m: float
    """Above mean sea level."""
    field_ned_gauss: Vec3
    """Magnetic field of the earth."""

    def lat_lon_e7(self, north_m: float, east_m: float) -> tuple[int, int]:
        """Latitude and longitude in 1e-7 degrees."""
        lat = self.lat_deg + north_m / METRES_PER_DEGREE
        lon = self.lon_deg + east_m / (METRES_PER_DEGREE * math.cos(math.radians(self.lat_deg)))
        return round(lat * 1e7), round(lon * 1e7)

    def mag_gauss(self, ap: Sensing) -> Vec3:
        """The field in body axes."""
        return rotate(conjugate(ap.sensed.ned_from_body_wxyz), self.field_ned_gauss)

    def global_position_int(self, ap: Sensing) -> Message | None:
        """GLOBAL_POSITION_INT; None without a position."""
        if not ap.position_ready:
            return None
        north, east, down = ap.sensed.position_ned_m
        return mav.MAVLink_global_position_int_message(
            boot_ms(ap),
            *self.lat_lon_e7(north, east),
            round(1000.0 * (self.alt_m - down)),
            round(-1000.0 * down),
            *int16(ap.sensed.velocity_ned_mps, 100.0),
            heading(yaw_rad(ap), 100.0),
        )

    def home_position(self, ap: Sensing) -> Message | None:
        """HOME_POSITION; None without a position."""
        if not ap.position_ready:
            return None
        altitude_mm, level = round(self.alt_m * 1000.0), [1.0, 0.0, 0.0, 0.0]
        return mav.MAVLink_home_position_message(
            *self.lat_lon_e7(0.0, 0.0), altitude_mm, 0.0, 0.0, 0.0, level, 0.0, 0.0, 0.0
        )


def boot_ms(ap: Sensing) -> int:
    """Time since boot in whole milliseconds, a uint32 that wraps after 49.7 days."""
    return ap.uptime_ns // 1_000_000 % 2**32


def boot_us(ap: Sensing) -> int:
    """Time since boot in whole microseconds."""
    return ap.uptime_ns // 1_000


def int16(values: Iterable[float], scale: float) -> list[int]:
    """Scaled, rounded and kept within a field of 16 bits."""
    return [max(-INT16, min(INT16, round(scale * value))) for value in values]


def yaw_rad(ap: Sensing) -> float:
    """Heading of the nose."""
    return to_euler(ap.sensed.ned_from_body_wxyz)[2]


def heading(angle_rad: float, units_per_degree: float = 1.0) -> int:
    """From 0 to below a full turn."""
    full_turn = round(360 * units_per_degree)
    return round(math.degrees(angle_rad) % 360.0 * units_per_degree) % full_turn


def servo_output_raw(ap: Sensing) -> Message:
    """SERVO_OUTPUT_RAW: motors at 1000..2000 us."""
    motors = (round(1000.0 + 1000.0 * m) for m in ap.motor_commands)
    return mav.MAVLink_servo_output_raw_message(boot_us(ap) & 0xFFFFFFFF, 0, *motors, 0, 0, 0, 0)
