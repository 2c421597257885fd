"""Rates of a flight in Hz, all in one place."""

from dataclasses import dataclass
from typing import Annotated

from cyclopts import Parameter

from mavbridge.config.flags import RATES, Between, Ranged, hidden

LEAST_HZ = 0.5
ACTION_HZ, SINGLE_HZ = 100.0, 30.0
"""Default maximum of chunks per second, at two rates and at one."""
SOLVES_PER_PLAY = 2.0
"""Chunks computed per play time: a new chunk arrives before the last one ends, even if a solve is
late."""
STATE_HZ = 50.0
"""Lowest requested telemetry rate, however slow the actions: age limits are in seconds."""
SIM_CAMERA_HZ = 30.0
"""Frame rate of the simulated camera, unless the visual rate is higher."""
SIM_CAMERA_PX = 224
"""Side of its frames in pixels, as ``python -m sitl`` sends them. The bridge resizes them like
those of a real camera."""
STATUS_HZ = 5.0
"""Refresh rate of the terminal."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopRates:
    """Rates of the two loops of a flight."""

    action_hz: float
    vision_hz: float

    @property
    def state_hz(self) -> float:
        """Telemetry rate to request from the vehicle."""
        return max(self.action_hz, STATE_HZ)


@Parameter(name="*", group=RATES)
@dataclass(frozen=True, kw_only=True)
class Rates(Ranged):
    """Loop rates in Hz."""

    visual_rate: Annotated[float, hidden("rates.visual"), Between(0.5, 240, "Hz")] = 30.0
    """Most images encoded per second (dual rate)."""
    action_rate: Annotated[float | None, hidden("rates.action"), Between(LEAST_HZ, 500, "Hz")] = (
        None
    )
    """Most chunks of actions per second (dual rate), each from the newest attitude; default: 100,
    or 2 / play_s for slow policies."""
    rate: Annotated[float | None, hidden("rates.single"), Between(LEAST_HZ, 500, "Hz")] = None
    """Most chunks of actions per second (single rate), each from the newest image; default: 30, or
    2 / play_s for slow policies."""
    stick_rate: Annotated[float, hidden("rates.stick"), Between(20, 400, "Hz")] = 100.0
    """Commands sent to the autopilot per second, independent of the policy's rate."""
    realtime: Annotated[bool, hidden("scheduling.realtime")] = True
    """Real-time scheduling (SCHED_FIFO) of the guard and of the policy, where the system permits
    it."""

    def loops(self, *, is_dual: bool, play_s: float = 0.0) -> LoopRates:
        """Return the rates of both loops, for a policy that plays each chunk for up to ``play_s``.

        At a single rate, images are only resized when they arrive. A chunk takes the newest image,
        so that they arrive at the visual rate even if chunks are slower: the image must not be old
        when it is used.
        """
        action_hz = self.action_rate if is_dual else self.rate
        if action_hz is None:
            action_hz = ACTION_HZ if is_dual else SINGLE_HZ
            if play_s > 0:
                action_hz = max(LEAST_HZ, min(action_hz, SOLVES_PER_PLAY / play_s))
        vision_hz = self.visual_rate if is_dual else max(action_hz, self.visual_rate)
        return LoopRates(action_hz=action_hz, vision_hz=vision_hz)
