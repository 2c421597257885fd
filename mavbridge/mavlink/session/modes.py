"""Flight modes by name, for ArduPilot's copters and PX4."""

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.errors import UserError
from mavbridge.core.vehicle import ModeRoles

_PX4_MODES = ("MANUAL", "ALTCTL", "POSCTL", "AUTO", "ACRO", "OFFBOARD", "STABILIZED")
"""Main modes of px4_custom_mode.h, from number 1 on: bits 16..23 of custom_mode."""
_PX4_AUTO = 4
_PX4_AUTO_MODES = {2: "TAKEOFF", 3: "LOITER", 4: "MISSION", 5: "RTL", 6: "LAND"}
"""Sub-modes of AUTO: bits 24..31."""


class ModeTable:
    """Names and numbers of one vehicle's flight modes; PX4's AUTO has one name a sub-mode."""

    def __init__(self, *, autopilot: str) -> None:
        self._is_px4 = autopilot == "px4"
        self._names: dict[int, str] = {
            number: entry.name.removeprefix("COPTER_MODE_")
            for number, entry in dialect.enums["COPTER_MODE"].items()
            if not entry.name.endswith("ENUM_END")
        }
        self._commands = {name: (number, 0) for number, name in self._names.items()}
        if self._is_px4:
            self._names = dict(enumerate(_PX4_MODES, start=1))
            self._commands = {
                name: (number, 0) for number, name in self._names.items() if number != _PX4_AUTO
            } | {f"AUTO.{name}": (_PX4_AUTO, sub) for sub, name in _PX4_AUTO_MODES.items()}

    @property
    def roles(self) -> ModeRoles:
        """All modes that can be asked for, and what each is good for."""
        if self._is_px4:
            return ModeRoles(
                names=tuple(self._commands),
                hold="AUTO.LOITER",
                land="AUTO.LAND",
                rtl="AUTO.RTL",
                takeoff=("AUTO.LOITER", "AUTO.TAKEOFF"),
                thrust=("MANUAL", "STABILIZED", "ACRO"),
                setpoint=("OFFBOARD",),
                needs_setpoints_first=True,
                is_silence_failsafe=True,
            )
        return ModeRoles(
            names=tuple(self._commands),
            hold="BRAKE",
            land="LAND",
            rtl="RTL",
            takeoff=("GUIDED",),
            thrust=("STABILIZE", "ACRO"),
            setpoint=("GUIDED", "GUIDED_NOGPS"),
        )

    def name(self, custom_mode: int) -> str:
        """Name of HEARTBEAT.custom_mode, or its number if it has no name."""
        number = custom_mode >> 16 & 0xFF if self._is_px4 else custom_mode
        name = self._names.get(number, str(number))
        if self._is_px4 and number == _PX4_AUTO:
            sub = custom_mode >> 24 & 0xFF
            return f"{name}.{_PX4_AUTO_MODES.get(sub, sub)}"
        return name

    def command(self, name: str) -> tuple[int, int]:
        """Parameters 2 and 3 of MAV_CMD_DO_SET_MODE.

        Raises:
            UserError: the vehicle has no such mode.
        """
        numbers = self._commands.get(name.upper())
        if numbers is None:
            raise UserError(
                f"this vehicle has no mode {name!r}; it has {', '.join(sorted(self._commands))}"
            )
        return numbers
