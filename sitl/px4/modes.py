"""Flight modes: PX4's main and sub modes, what each needs, and the flags of its heartbeat."""

from enum import Enum

from pymavlink.dialects.v20 import ardupilotmega as mav

MAIN_AUTO = 4
_SUB_ANY = (1, 2)  # POSCTL's orbit and slow flight; both are flown as POSCTL here


class Mode(Enum):
    """Flight mode: main and sub mode of HEARTBEAT.custom_mode, its name in status texts, its number
    as the argument of an event, and its MAV_STANDARD_MODE."""

    MANUAL = (1, 0, "Manual", 0, 0)
    ALTCTL = (2, 0, "Altitude", 1, 4)
    POSCTL = (3, 0, "Position", 2, 1)
    AUTO_TAKEOFF = (4, 2, "Takeoff", 10, 8)
    AUTO_LOITER = (4, 3, "Hold", 4, 0)
    AUTO_MISSION = (4, 4, "Mission", 3, 6)
    AUTO_RTL = (4, 5, "RTL", 5, 5)
    AUTO_LAND = (4, 6, "Land", 11, 7)
    ACRO = (5, 0, "Acro", 6, 0)
    OFFBOARD = (6, 0, "Offboard", 7, 0)
    STAB = (7, 0, "Stabilized", 8, 0)
    TERMINATION = (10, 0, "Termination", 255, 0)

    def __init__(self, main: int, sub: int, spoken: str, event_number: int, standard: int) -> None:
        self.main, self.sub = main, sub
        self.spoken = spoken
        self.event_number = event_number
        self.standard = standard

    @property
    def custom_mode(self) -> int:
        """The number in HEARTBEAT and CURRENT_MODE."""
        return self.main << 16 | self.sub << 24

    @property
    def label(self) -> str:
        """The name in PX4's words: AUTO.LOITER."""
        return self.name.replace("_", ".")

    @property
    def manual_throttle(self) -> bool:
        """The throttle stick is thrust: for arming it must be down."""
        return self in (Mode.MANUAL, Mode.STAB, Mode.ACRO)

    @property
    def piloted(self) -> bool:
        """The sticks fly it: refused without them."""
        return self.manual_throttle or self in (Mode.ALTCTL, Mode.POSCTL)

    @property
    def is_auto(self) -> bool:
        """One of the AUTO modes."""
        return self.main == MAIN_AUTO

    @property
    def needs_position(self) -> bool:
        """Refused in flight, and for arming, while there is no position."""
        return self is Mode.POSCTL or (self.is_auto and self is not Mode.AUTO_LAND)

    @property
    def armable(self) -> bool:
        """The vehicle can be armed in it, where its other needs are met."""
        return self not in (Mode.AUTO_LAND, Mode.AUTO_RTL, Mode.AUTO_MISSION, Mode.TERMINATION)

    @property
    def base_flags(self) -> int:
        """MAV_MODE_FLAG of the heartbeat, without the armed bit; OFFBOARD's is the plain one."""
        if self.is_auto:
            stabilized = mav.MAV_MODE_FLAG_STABILIZE_ENABLED | mav.MAV_MODE_FLAG_GUIDED_ENABLED
            return _CUSTOM | int(stabilized) | int(mav.MAV_MODE_FLAG_AUTO_ENABLED)
        if self is Mode.ACRO:
            return _CUSTOM | int(mav.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED)
        if self.piloted:
            manual = mav.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED | mav.MAV_MODE_FLAG_STABILIZE_ENABLED
            return _CUSTOM | int(manual)
        return _CUSTOM


_CUSTOM = int(mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED)


def mode_of(main: int, sub: int) -> Mode | None:
    """The mode of these numbers, or None; AUTO without a sub mode is a mission."""
    if (main, sub) == (MAIN_AUTO, 0):
        return Mode.AUTO_MISSION
    if main == Mode.POSCTL.main and sub in _SUB_ANY:
        return Mode.POSCTL
    return next((mode for mode in Mode if (mode.main, mode.sub) == (main, sub)), None)
