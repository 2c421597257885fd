"""Flight modes by name, for ArduPilot and PX4."""

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.errors import UserError

_PX4_MAIN = {
    "MANUAL": 1,
    "ALTCTL": 2,
    "POSCTL": 3,
    "AUTO": 4,
    "ACRO": 5,
    "OFFBOARD": 6,
    "STABILIZED": 7,
}
"""px4_custom_mode.h main modes: bits 16..23 of custom_mode."""

_ARDUPILOT_FAMILY = {
    dialect.MAV_TYPE_FIXED_WING: "PLANE_MODE",
    dialect.MAV_TYPE_GROUND_ROVER: "ROVER_MODE",
    dialect.MAV_TYPE_SUBMARINE: "SUB_MODE",
}


def _ardupilot_modes(vehicle_type: int) -> dict[str, int]:
    family = _ARDUPILOT_FAMILY.get(vehicle_type, "COPTER_MODE")
    return {
        entry.name.removeprefix(f"{family}_"): number
        for number, entry in dialect.enums[family].items()
        if not entry.name.endswith("ENUM_END")
    }


class ModeTable:
    """Names and numbers of one vehicle's flight modes."""

    def __init__(self, *, autopilot: str, vehicle_type: int) -> None:
        self._is_px4 = autopilot == "px4"
        self._numbers = _PX4_MAIN if self._is_px4 else _ardupilot_modes(vehicle_type)
        self._names = {number: name for name, number in self._numbers.items()}

    def name(self, custom_mode: int) -> str:
        """Name of HEARTBEAT.custom_mode, or its number if it has no name."""
        number = custom_mode >> 16 & 0xFF if self._is_px4 else custom_mode
        return self._names.get(number, str(number))

    def number(self, name: str) -> int:
        """Parameter 2 of MAV_CMD_DO_SET_MODE for this mode.

        Raises:
            UserError: this vehicle has no such mode.
        """
        number = self._numbers.get(name.upper())
        if number is None:
            raise UserError(
                f"this vehicle has no mode {name!r}; it has {', '.join(sorted(self._numbers))}"
            )
        return number
