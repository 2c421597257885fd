"""Radio channel readings, and the switches among them."""

from typing import Literal, TypeAlias

from mavbridge.core.clock import NS_PER_MS

RADIO_US = range(800, 2201)
"""PWM range of a radio. No other value is sent, even if the vehicle's calibration demands it; as a
reading (0, 65535) it is an undriven channel."""
ON_US, OFF_US = 1800, 1200
"""ArduPilot's thresholds of a high and a low switch."""
DWELL_NS = 200 * NS_PER_MS
"""Debounce time, as in ArduPilot."""
GAP_NS = 500 * NS_PER_MS
"""Longest gap between two readings: ten periods of 20 Hz, the slowest requested rate."""

SwitchPosition: TypeAlias = Literal["low", "middle", "high"]


class Switch:
    """Switch, debounced by the arrival times of its readings.

    Going high counts as an act only after a rest: a receiver that drops out and comes back moves
    its channels as a hand would.
    """

    def __init__(
        self, *, rest_ns: int = DWELL_NS, rests: tuple[SwitchPosition, ...] = ("low",)
    ) -> None:
        """``rest_ns``: least time in a position of ``rests`` before going high counts again.

        The debounce time is enough the first time, when no dropout can have happened.
        """
        self._again_ns, self._rests = rest_ns, rests
        self._rest_ns = DWELL_NS
        self._has_rested = False
        self._since_ns = 0
        self.newest_ns: int | None = None
        """Arrival of the newest reading; None before the first."""
        self.position: SwitchPosition | None = None
        """Position of the newest reading; None before the first, and after the receiver was
        lost."""
        self.is_off = False
        """True if it was low and has not been high for the dwell time since."""
        self.is_on = False
        """True if it was high for the dwell time and has not been low since."""

    def read(self, value_us: int, arrived_ns: int) -> bool:
        """Add a reading; return True if this is the act of going high."""
        if value_us not in RADIO_US:
            return False
        before = self.position
        if is_late := self.newest_ns is not None and arrived_ns - self.newest_ns > GAP_NS:
            self.forget()
        position: SwitchPosition = (
            "high" if value_us > ON_US else "low" if value_us < OFF_US else "middle"
        )
        if position != self.position:
            self.position, self._since_ns = position, arrived_ns
        self.newest_ns = arrived_ns
        held_ns = arrived_ns - self._since_ns
        if position == "low":
            self.is_off, self.is_on = True, False
        elif position == "high" and is_late and before == "high":
            self.is_off, self.is_on = False, True  # on a slow link; no act
        if position in self._rests:
            self._has_rested |= held_ns >= self._rest_ns
        elif position == "high" and held_ns >= DWELL_NS:
            self._rest_ns = self._again_ns
            self.is_off, self.is_on = False, True
            is_act, self._has_rested = self._has_rested, False
            return is_act
        return False

    def forget(self) -> None:
        """Forget the position and the rest: the receiver is lost."""
        self.position, self._has_rested, self._rest_ns = None, False, self._again_ns
