"""From a hand on the sticks to the channels of a receiver."""

from collections.abc import Sequence
from typing import Literal, NamedTuple, Protocol

from sitl.clock import NS_PER_MS, NS_PER_S
from sitl.expert.stick_response import CENTRED, StickPositions

SWITCH_CHANNEL = 7
"""Channel of the pilot's spare switch, from 1; `mavbridge record --episode-channel 7`."""
OFF_US = (0,) * 8
"""No signal: the receiver has lost the transmitter."""
PERIOD_NS = 20 * NS_PER_MS
"""Between two frames of a receiver."""
GESTURE_THROTTLE, GESTURE_YAW = -1.0, 1.0
_SWITCH_US = {"low": 1000, "middle": 1500, "high": 2000}
_FIRST_MODE_US, _MODE_US = 1100, 1500
"""The mode switch is moved once after the start: ArduPilot takes no notice of where it stands
before. At 1500 us the simulated vehicle is in ALT_HOLD."""
_MODE_AFTER_NS = NS_PER_S

Switch = Literal["low", "middle", "high"]
Gesture = Literal["arm", "disarm"]


class Hand(NamedTuple):
    """What the pilot does with the transmitter."""

    sticks: StickPositions = CENTRED
    gesture: Gesture | None = None
    """Throttle down and yaw full right arms, full left disarms, in place of ``sticks``."""
    switch: Switch = "low"


class Pilot(Protocol):
    """Whoever moves the receiver; polled by the loop of the vehicle, never waits."""

    def latest(self) -> Sequence[int] | None:
        """Channels in microseconds, as ``Autopilot.set_receiver`` takes them; None = as before."""

    def close(self) -> None:
        """Free what it has opened."""


class Transmitter:
    """Channels of a hand, at the rate of a receiver; the mode switch moves by itself."""

    def __init__(self, start_ns: int) -> None:
        self._start_ns = start_ns
        self._due_ns = start_ns

    def begins_frame(self, now_ns: int) -> bool:
        """It is time for another frame; true once for each."""
        if now_ns < self._due_ns:
            return False
        is_on_time = now_ns - self._due_ns < PERIOD_NS
        self._due_ns = (self._due_ns if is_on_time else now_ns) + PERIOD_NS
        return True

    def channels_us(self, hand: Hand, now_ns: int) -> tuple[int, ...]:
        """Roll, pitch, throttle, yaw, mode, nothing, the switch, nothing."""
        throttle, yaw, pitch, roll = hand.sticks
        if hand.gesture is not None:
            side = GESTURE_YAW if hand.gesture == "arm" else -GESTURE_YAW
            throttle, yaw, pitch, roll = GESTURE_THROTTLE, side, 0.0, 0.0
        is_begun = now_ns - self._start_ns < _MODE_AFTER_NS
        mode_us = _FIRST_MODE_US if is_begun else _MODE_US
        sticks = (_us(roll), _us(-pitch), _us(throttle), _us(yaw))
        return (*sticks, mode_us, 1500, _SWITCH_US[hand.switch], 1500)


def _us(position: float) -> int:
    """Less is left, nose down and descent, as ArduCopter and PX4 have them."""
    return round(1500 + 500 * max(-1.0, min(1.0, position)))
