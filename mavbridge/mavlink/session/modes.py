"""Flight modes by name, for ArduPilot and PX4."""

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.errors import UserError

_PX4_MODES = ("MANUAL", "ALTCTL", "POSCTL", "AUTO", "ACRO", "OFFBOARD", "STABILIZED")
"""Main modes of px4_custom_mode.h, from number 1 on: bits 16..23 of custom_mode."""

_ARDUPILOT_FAMILY = {
    dialect.MAV_TYPE_FIXED_WING: "PLANE_MODE",
    dialect.MAV_TYPE_GROUND_ROVER: "ROVER_MODE",
    dialect.MAV_TYPE_SUBMARINE: "SUB_MODE",
}


class ModeTable:
    """Names and numbers of one vehicle's flight modes."""

    def __init__(self, *, autopilot: str, vehicle_type: int) -> None:
        self._is_px4 = autopilot == "px4"
        family = _ARDUPILOT_FAMILY.get(vehicle_type, "COPTER_MODE")
        self._names: dict[int, str] = {
            number: entry.name.removeprefix(f"{family}_")
            for number, entry in dialect.enums[family].items()
            if not entry.name.endswith("ENUM_END")
        }
        if self._is_px4:
            self._names = dict(enumerate(_PX4_MODES, start=1))
        self._numbers = {name: number for number, name in self._names.items()}

    def name(self, custom_mode: int) -> str:
        """Name of HEARTBEAT.custom_mode, or its number if it has no name."""
        number = custom_mode >> 16 & 0xFF if self._is_px4 else custom_mode
        return self._names.get(number, str(number))

    def number(self, name: str) -> int:
        """Parameter 2 of MAV_CMD_DO_SET_MODE; raises UserError if the vehicle has no such mode."""
        number = self._numbers.get(name.upper())
        if number is None:
            raise UserError(
                f"this vehicle has no mode {name!r}; it has {', '.join(sorted(self._numbers))}"
            )
        return number
