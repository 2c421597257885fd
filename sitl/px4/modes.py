"""PX4's flight modes, and the modes that a failsafe selects."""

from enum import Enum

from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.clock import NS_PER_S
from sitl.px4.params import Px4Params

MAIN_AUTO = 4
_SUB_ANY = (1, 2)  # POSCTL's orbit and slow flight, flown here as POSCTL


class Px4Mode(Enum):
    """Flight mode.

    Values: main and sub mode of HEARTBEAT.custom_mode, name in status texts, MAV_STANDARD_MODE.
    """

    MANUAL = (1, 0, "Manual", 0)
    ALTCTL = (2, 0, "Altitude", 4)
    POSCTL = (3, 0, "Position", 1)
    AUTO_TAKEOFF = (4, 2, "Takeoff", 8)
    AUTO_LOITER = (4, 3, "Hold", 0)
    AUTO_MISSION = (4, 4, "Mission", 6)
    AUTO_RTL = (4, 5, "RTL", 5)
    AUTO_LAND = (4, 6, "Land", 7)
    ACRO = (5, 0, "Acro", 0)
    OFFBOARD = (6, 0, "Offboard", 0)
    STAB = (7, 0, "Stabilized", 0)

    def __init__(self, main: int, sub: int, spoken: str, standard: int) -> None:
        self.main, self.sub, self.spoken, self.standard = main, sub, spoken, standard
        self.custom_mode = main << 16 | sub << 24
        self.is_auto = main == MAIN_AUTO
        self.manual_throttle = main in (1, 5, 7)  # the stick is thrust: down for arming
        self.piloted = main in (1, 2, 3, 5, 7)  # flown by sticks: refused without them
        self.needs_position = main == 3 or (self.is_auto and sub != 6)
        self.armable = (main, sub) not in ((4, 4), (4, 5), (4, 6))
        flags = mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        if self.piloted:
            flags |= mav.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED
        if self.is_auto:
            flags |= mav.MAV_MODE_FLAG_GUIDED_ENABLED | mav.MAV_MODE_FLAG_AUTO_ENABLED
        if (self.piloted and main != 5) or self.is_auto:
            flags |= mav.MAV_MODE_FLAG_STABILIZE_ENABLED
        self.base_flags = int(flags)
        """MAV_MODE_FLAG bits of the heartbeat, without the armed and OFFBOARD's setpoint bit."""

    @property
    def label(self) -> str:
        return self.name.replace("_", ".")


def mode_of(main: int, sub: int) -> Px4Mode | None:
    """Return the mode with these numbers, or None; AUTO without a sub mode is a mission."""
    if (main, sub) == (MAIN_AUTO, 0):
        return Px4Mode.AUTO_MISSION
    if main == Px4Mode.POSCTL.main and sub in _SUB_ANY:
        return Px4Mode.POSCTL
    return next((mode for mode in Px4Mode if (mode.main, mode.sub) == (main, sub)), None)


REFILL = 0.25

_STICKS_LOST_MODES = {1: Px4Mode.AUTO_LOITER, 2: Px4Mode.AUTO_RTL, 3: Px4Mode.AUTO_LAND}
_STREAM_LOST_MODES = {
    0: Px4Mode.POSCTL,
    1: Px4Mode.ALTCTL,
    2: Px4Mode.STAB,
    3: Px4Mode.AUTO_RTL,
    4: Px4Mode.AUTO_LAND,
    5: Px4Mode.AUTO_LOITER,
}
_EXCEPT, _EXCEPT_AUTO = {Px4Mode.AUTO_MISSION: 1, Px4Mode.OFFBOARD: 4}, 2
"""Bits of COM_RCL_EXCEPT."""


class Phase(Enum):
    """Phase of the failsafe for lost sticks."""

    NONE = 0
    HOLDING = 1
    ACTING = 2


class LostSticks:
    """Latched failsafe for lost sticks: Hold for COM_FAIL_ACT_T, then the action of NAV_RCL_ACT.

    It continues even if the sticks come back. The delay is a budget: a Hold consumes it, and it
    recovers at a quarter of that speed, or at once when any parameter changes.
    """

    def __init__(self, params: Px4Params) -> None:
        self._params = params
        self.phase = Phase.NONE
        self._spent_s = 0.0
        self._param_changes = params.changes

    @property
    def active(self) -> bool:
        return self.phase is not Phase.NONE

    @property
    def delay_s(self) -> float:
        """Duration of the next Hold, or the rest of the present one."""
        return max(0.0, self._params["COM_FAIL_ACT_T"] - self._spent_s)

    def is_excepted(self, mode: Px4Mode) -> bool:
        if mode in (Px4Mode.AUTO_RTL, Px4Mode.AUTO_LAND):
            return True
        bit = _EXCEPT.get(mode, _EXCEPT_AUTO if mode.is_auto else 0)
        return bool(self._params.integer("COM_RCL_EXCEPT") & bit)

    def start(self) -> None:
        self.phase = Phase.HOLDING if self.delay_s > 0.0 else Phase.ACTING

    def clear(self) -> None:
        """End the failsafe by a command or the pilot; the budget stays."""
        self.phase = Phase.NONE

    def update(self, dt_ns: int) -> bool:
        """Advance the time. Return True when the Hold ends and the action begins."""
        if self._params.changes != self._param_changes:
            self._param_changes, self._spent_s = self._params.changes, 0.0
        if self.phase is not Phase.HOLDING:
            self._spent_s = max(0.0, self._spent_s - REFILL * dt_ns / NS_PER_S)
            return False
        self._spent_s += dt_ns / NS_PER_S
        if self.delay_s > 0.0:
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
