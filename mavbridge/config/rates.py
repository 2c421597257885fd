"""Rates of a flight in Hz, all in one place."""

import math
from dataclasses import dataclass
from typing import Annotated

from cyclopts import Parameter

from mavbridge.config.flags import RATES, Between, Ranged, check_range, hidden
from mavbridge.core.errors import UserError

LEAST_HZ = 0.5
AUTO_VISUAL_HZ = (10.0, 60.0)
"""Default limits of rates.visual = "auto"."""
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
    min_vision_hz: float
    max_vision_hz: float
    """Equal to the minimum if the visual rate is fixed."""

    @property
    def state_hz(self) -> float:
        """Telemetry rate to request from the vehicle."""
        return max(self.action_hz, STATE_HZ)


@Parameter(name="*", group=RATES)
@dataclass(frozen=True, kw_only=True)
class Rates(Ranged):
    """Loop rates in Hz."""

    visual_rate: Annotated[float | str, hidden("rates.visual")] = 30.0
    """Most images encoded per second (dual rate); auto[:MIN:MAX] encodes more often when the
    vehicle turns or the image changes."""
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
    guard_cpu: Annotated[int | None, hidden("scheduling.guard-cpu")] = None
    """Pin the guard to this CPU."""
    action_cpu: Annotated[int | None, hidden("scheduling.action-cpu")] = None
    """Pin the policy to this CPU."""
    vision_cpu: Annotated[int | None, hidden("scheduling.vision-cpu")] = None
    """Pin the vision loop to this CPU."""

    def __post_init__(self) -> None:
        """Raise UserError for rates that no autopilot supports."""
        super().__post_init__()
        low_hz, high_hz = self.visual_limits_hz
        check_range("rates.visual", low_hz, 0.5, high_hz, "Hz")
        check_range("rates.visual", high_hz, low_hz, 240, "Hz")

    @property
    def visual_limits_hz(self) -> tuple[float, float]:
        """Minimum and maximum frames per second; equal if the rate is fixed."""
        if isinstance(self.visual_rate, float | int):
            return self.visual_rate, self.visual_rate
        kind, *limits = self.visual_rate.split(":")
        try:
            low_hz, high_hz = map(float, limits) if limits else AUTO_VISUAL_HZ
        except ValueError:
            low_hz, high_hz = math.nan, math.nan
        if kind != "auto" or math.isnan(low_hz) or math.isnan(high_hz):
            raise UserError(
                f"rates.visual {self.visual_rate} is neither a rate in Hz nor auto[:MIN:MAX]"
            )
        return low_hz, high_hz

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
        min_hz, max_hz = self.visual_limits_hz
        if not is_dual:
            min_hz = max_hz = max(action_hz, max_hz)
        return LoopRates(action_hz=action_hz, min_vision_hz=min_hz, max_vision_hz=max_hz)
