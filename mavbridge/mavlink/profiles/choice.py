"""Supported firmware and vehicle types."""

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.errors import PeerError
from mavbridge.mavlink.profiles.ardupilot import ARDUPILOT
from mavbridge.mavlink.profiles.profile import Profile
from mavbridge.mavlink.profiles.px4 import PX4

_PROFILES: dict[int, Profile] = {
    dialect.MAV_AUTOPILOT_ARDUPILOTMEGA: ARDUPILOT,
    dialect.MAV_AUTOPILOT_PX4: PX4,
}
_MULTIROTORS = (
    *(dialect.MAV_TYPE_QUADROTOR, dialect.MAV_TYPE_HEXAROTOR, dialect.MAV_TYPE_OCTOROTOR),
    *(dialect.MAV_TYPE_TRICOPTER, dialect.MAV_TYPE_COAXIAL),
    *(dialect.MAV_TYPE_DECAROTOR, dialect.MAV_TYPE_DODECAROTOR),
)


def require_profile(autopilot: int, vehicle_type: int) -> Profile:
    """Return the profile of a multirotor's firmware.

    Raises:
        PeerError: the firmware is not supported, or the vehicle is no multirotor.
    """
    if autopilot not in _PROFILES:
        raise PeerError(
            f"the vehicle's firmware is {_name('MAV_AUTOPILOT', autopilot)}, and only ArduPilot "
            "and PX4 are flown"
        )
    if vehicle_type not in _MULTIROTORS:
        name = _name("MAV_TYPE", vehicle_type)
        raise PeerError(f"the vehicle is a {name}, and only multirotors are flown")
    return _PROFILES[autopilot]


def _name(enum: str, number: int) -> str:
    entry = dialect.enums[enum].get(number)
    name = entry.name.removeprefix(f"{enum}_") if entry else "unknown"
    return f"{name} ({enum} {number})"
