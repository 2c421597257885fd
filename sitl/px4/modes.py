"""Flight modes: PX4's main and sub modes, what each needs, and the flags of its heartbeat."""

from enum import Enum

from pymavlink.dialects.v20 import ardupilotmega as mav

MAIN_AUTO = 4
_SUB_ANY = (1, 2)  # POSCTL's orbit and slow flight; both are flown as POSCTL here


class Mode(Enum):
    """Flight mode by its main and sub mode in HEARTBEAT.custom_mode."""

    MANUAL = (1, 0)
    ALTCTL = (2, 0)
    POSCTL = (3, 0)
    AUTO_TAKEOFF = (4, 2)
    AUTO_LOITER = (4, 3)
    AUTO_MISSION = (4, 4)
    AUTO_RTL = (4, 5)
    AUTO_LAND = (4, 6)
    ACRO = (5, 0)
    OFFBOARD = (6, 0)
    STAB = (7, 0)
    TERMINATION = (10, 0)

    @property
    def custom_mode(self) -> int:
        """The number in HEARTBEAT and CURRENT_MODE."""
        main, sub = self.value
        return int(main) << 16 | int(sub) << 24

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
        return int(self.value[0]) == MAIN_AUTO

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

SPOKEN_NAMES = {
    Mode.MANUAL: "Manual",
    Mode.ALTCTL: "Altitude",
    Mode.POSCTL: "Position",
    Mode.AUTO_TAKEOFF: "Takeoff",
    Mode.AUTO_LOITER: "Hold",
    Mode.AUTO_MISSION: "Mission",
    Mode.AUTO_RTL: "RTL",
    Mode.AUTO_LAND: "Land",
    Mode.ACRO: "Acro",
    Mode.OFFBOARD: "Offboard",
    Mode.STAB: "Stabilized",
    Mode.TERMINATION: "Termination",
}
"""As status texts have them."""


def mode_of(main: int, sub: int) -> Mode | None:
    """The mode of these numbers, or None; AUTO without a sub mode is a mission."""
    if (main, sub) == (MAIN_AUTO, 0):
        return Mode.AUTO_MISSION
    if main == Mode.POSCTL.value[0] and sub in _SUB_ANY:
        return Mode.POSCTL
    try:
        return Mode((main, sub))
    except ValueError:
        return None
