"""Flight modes: ArduCopter's numbers, and what each demands and allows."""

from enum import IntEnum


class Mode(IntEnum):
    """HEARTBEAT.custom_mode."""

    STABILIZE = 0
    ACRO = 1
    ALT_HOLD = 2
    RTL = 6
    LAND = 9

    @property
    def manual_throttle(self) -> bool:
        """The throttle stick is thrust; refused in RC failsafe, and for arming it must be down."""
        return self in (Mode.STABILIZE, Mode.ACRO)

    @property
    def piloted(self) -> bool:
        """The sticks fly it; also the modes in which it can be armed."""
        return self in (Mode.STABILIZE, Mode.ACRO, Mode.ALT_HOLD)
