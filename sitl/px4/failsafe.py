"""What follows when sticks or the stream of setpoints are lost.

Lost sticks latch: a Hold of COM_FAIL_ACT_T, then the action of NAV_RCL_ACT, whatever the sticks do
meanwhile. The delay is a budget that shrinks in such a Hold and comes back at a quarter of that
speed, or at once when any parameter changes. A lost stream does not latch: its action ends when
the stream is back.
"""

from enum import Enum

from sitl.clock import NS_PER_S
from sitl.px4.modes import Mode
from sitl.px4.params import Px4Params

REFILL = 0.25

_STICKS_LOST_MODES = {1: Mode.AUTO_LOITER, 2: Mode.AUTO_RTL, 3: Mode.AUTO_LAND}
_STREAM_LOST_MODES = {
    0: Mode.POSCTL,
    1: Mode.ALTCTL,
    2: Mode.STAB,
    3: Mode.AUTO_RTL,
    4: Mode.AUTO_LAND,
    5: Mode.AUTO_LOITER,
}
_EXCEPT_MISSION, _EXCEPT_AUTO, _EXCEPT_OFFBOARD = 1, 2, 4


class Phase(Enum):
    """Where a failsafe of lost sticks stands."""

    NONE = 0
    HOLDING = 1
    ACTING = 2


class LostSticks:
    """The latched failsafe of lost sticks, and its budget of delay."""

    def __init__(self, params: Px4Params) -> None:
        self._params = params
        self.phase = Phase.NONE
        self._spent_s = 0.0
        self._param_changes = params.changes

    @property
    def active(self) -> bool:
        """The failsafe has the vehicle."""
        return self.phase is not Phase.NONE

    @property
    def delay_s(self) -> float:
        """How long the next Hold would be, or how much is left of this one."""
        return max(0.0, self._params["COM_FAIL_ACT_T"] - self._spent_s)

    def is_excepted(self, mode: Mode) -> bool:
        """Lost sticks do not matter in this mode."""
        bits = self._params.integer("COM_RCL_EXCEPT")
        if mode in (Mode.AUTO_RTL, Mode.AUTO_LAND, Mode.TERMINATION):
            return True
        if mode is Mode.AUTO_MISSION:
            return bool(bits & _EXCEPT_MISSION)
        if mode is Mode.OFFBOARD:
            return bool(bits & _EXCEPT_OFFBOARD)
        return mode.is_auto and bool(bits & _EXCEPT_AUTO)

    def start(self) -> None:
        """The sticks have just been lost."""
        self.phase = Phase.HOLDING if self.delay_s > 0.0 else Phase.ACTING

    def clear(self) -> None:
        """A command, or the pilot, has ended it; the budget is what it is."""
        self.phase = Phase.NONE

    def update(self, dt_ns: int) -> bool:
        """Count the time; True when the Hold is over and the action begins."""
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

    def mode(self) -> Mode:
        """The mode that it demands now."""
        if self.phase is Phase.HOLDING:
            return Mode.AUTO_LOITER
        return _STICKS_LOST_MODES.get(self._params.integer("NAV_RCL_ACT"), Mode.AUTO_RTL)


def mode_without_stream(params: Px4Params, *, has_sticks: bool) -> Mode:
    """The mode that takes over from OFFBOARD without setpoints; RTL where it needs sticks."""
    mode = _STREAM_LOST_MODES.get(params.integer("COM_OBL_RC_ACT"), Mode.AUTO_RTL)
    return Mode.AUTO_RTL if mode.piloted and not has_sticks else mode
