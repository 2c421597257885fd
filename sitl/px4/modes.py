"""PX4's flight modes, and the modes that a failsafe selects."""

from enum import Enum

from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.clock import NS_PER_S
from sitl.px4.params import Px4Params

MAIN_AUTO = 4


class Px4Mode(Enum):
    """Flight mode.

    Values: main and sub mode of HEARTBEAT.custom_mode, MAV_STANDARD_MODE.
    """

    MANUAL = (1, 0, 0)
    ALTCTL = (2, 0, 4)
    POSCTL = (3, 0, 1)
    AUTO_TAKEOFF = (4, 2, 8)
    AUTO_LOITER = (4, 3, 0)
    AUTO_RTL = (4, 5, 5)
    AUTO_LAND = (4, 6, 7)
    OFFBOARD = (6, 0, 0)
    STAB = (7, 0, 0)

    def __init__(self, main: int, sub: int, standard: int) -> None:
        self.main, self.sub, self.standard = main, sub, standard
        self.custom_mode = main << 16 | sub << 24
        self.is_auto = main == MAIN_AUTO
        self.manual_throttle = main in (1, 7)  # the stick is thrust: down for arming
        self.piloted = main in (1, 2, 3, 7)  # flown by sticks: refused without them
        self.needs_position = main == 3 or (self.is_auto and sub != 6)
        self.armable = (main, sub) not in ((4, 5), (4, 6))
        flags = mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        if self.piloted:
            flags |= mav.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED | mav.MAV_MODE_FLAG_STABILIZE_ENABLED
        if self.is_auto:
            flags |= mav.MAV_MODE_FLAG_GUIDED_ENABLED | mav.MAV_MODE_FLAG_AUTO_ENABLED
            flags |= mav.MAV_MODE_FLAG_STABILIZE_ENABLED
        self.base_flags = int(flags)
        """MAV_MODE_FLAG bits of the heartbeat, without the armed bit."""

    @property
    def label(self) -> str:
        return self.name.replace("_", ".")


def mode_of(main: int, sub: int) -> Px4Mode | None:
    """Return the mode with these numbers, or None."""
    return next((mode for mode in Px4Mode if (mode.main, mode.sub) == (main, sub)), None)


_STICKS_LOST_MODES = {1: Px4Mode.AUTO_LOITER, 2: Px4Mode.AUTO_RTL, 3: Px4Mode.AUTO_LAND}
_STREAM_LOST_MODES = {
    0: Px4Mode.POSCTL,
    1: Px4Mode.ALTCTL,
    2: Px4Mode.STAB,
    3: Px4Mode.AUTO_RTL,
    4: Px4Mode.AUTO_LAND,
    5: Px4Mode.AUTO_LOITER,
}
_EXCEPT_AUTO, _EXCEPT_OFFBOARD = 2, 4  # bits of COM_RCL_EXCEPT


class Phase(Enum):
    """Phase of the failsafe for lost sticks."""

    NONE = 0
    HOLDING = 1
    ACTING = 2


class LostSticks:
    """Latched failsafe for lost sticks: Hold for COM_FAIL_ACT_T, then the action of NAV_RCL_ACT.

    It continues even if the sticks come back. Unlike PX4's, the next one holds as long again.
    """

    def __init__(self, params: Px4Params) -> None:
        self._params = params
        self.phase = Phase.NONE
        self._held_s = 0.0

    @property
    def active(self) -> bool:
        return self.phase is not Phase.NONE

    @property
    def delay_s(self) -> float:
        """Duration of a Hold."""
        return self._params["COM_FAIL_ACT_T"]

    def is_excepted(self, mode: Px4Mode) -> bool:
        if mode in (Px4Mode.AUTO_RTL, Px4Mode.AUTO_LAND):
            return True
        is_offboard = mode is Px4Mode.OFFBOARD
        bit = _EXCEPT_OFFBOARD if is_offboard else _EXCEPT_AUTO if mode.is_auto else 0
        return bool(self._params.integer("COM_RCL_EXCEPT") & bit)

    def start(self) -> None:
        self._held_s = 0.0
        self.phase = Phase.HOLDING if self.delay_s > 0.0 else Phase.ACTING

    def clear(self) -> None:
        """End the failsafe by a command or the pilot."""
        self.phase = Phase.NONE

    def update(self, dt_ns: int) -> bool:
        """Advance the time. Return True when the Hold ends and the action begins."""
        self._held_s += dt_ns / NS_PER_S
        if self.phase is not Phase.HOLDING or self._held_s < self.delay_s:
            return False
        self.phase = Phase.ACTING
        return True

    def mode(self) -> Px4Mode:
        if self.phase is Phase.HOLDING:
            return Px4Mode.AUTO_LOITER
        return _STICKS_LOST_MODES.get(self._params.integer("NAV_RCL_ACT"), Px4Mode.AUTO_RTL)


def mode_without_stream(params: Px4Params, *, has_sticks: bool) -> Px4Mode:
    """Return the mode that replaces OFFBOARD without setpoints; RTL if that one lacks sticks."""
    mode = _STREAM_LOST_MODES.get(params.integer("COM_OBL_RC_ACT"), Px4Mode.AUTO_RTL)
    return Px4Mode.AUTO_RTL if mode.piloted and not has_sticks else mode
