"""Every rate of the flight in Hz, and the only place that holds one."""

import math
from dataclasses import dataclass
from typing import Annotated

from cyclopts import Parameter

from mavbridge.config.flags import RATES, check_range, hidden
from mavbridge.core.errors import UserError

LEAST_HZ = 0.5
AUTO_VISUAL_HZ = (10.0, 60.0)
"""Limits of rates.visual = "auto" where none are given."""
ACTION_HZ, SINGLE_HZ = 100.0, 30.0
"""Most chunks a second, by dual and by single rate, where neither a flag nor the policy says it."""
SOLVES_PER_PLAY = 2.0
"""Chunks that are computed in the time for which a policy is meant to play one: a new one is there
before the last one ends, also when a solve is late."""
STATE_HZ = 50.0
"""Lowest rate of telemetry to ask for, however slow the actions: age limits are in seconds."""
SIM_CAMERA_HZ = 30.0
"""Frames a second of the simulated camera, unless the visual rate asks for more."""
SIM_CAMERA_PX = 224
"""Side of its frames in pixels, as ``python -m sitl`` sends them. The bridge resizes them to what
the policy takes, as it does with a real camera."""
STATUS_HZ = 5.0
"""Terminal refresh."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopRates:
    """Rates of the two loops of one flight, in Hz."""

    action_hz: float
    min_vision_hz: float
    max_vision_hz: float
    """Equal to the minimum where the visual rate is fixed."""

    @property
    def state_hz(self) -> float:
        """Rate of telemetry to ask the vehicle for."""
        return max(self.action_hz, STATE_HZ)


@Parameter(name="*", group=RATES)
@dataclass(frozen=True, kw_only=True)
class Rates:
    """Loop rates in Hz."""

    visual_rate: Annotated[float | str, hidden("rates.visual")] = 30.0
    """Most frames a second through the image encoder (dual rate); auto[:MIN:MAX] encodes more often
    when the vehicle turns or the image changes."""
    action_rate: Annotated[float | None, hidden("rates.action")] = None
    """Most chunks of actions a second, each from the newest attitude (dual rate). By default 100,
    or 2 for each time that the policy is meant to play a chunk (play_s of its contract)."""
    rate: Annotated[float | None, hidden("rates.single")] = None
    """Most chunks a second in single-rate mode, each with the newest image. By default 30, or 2 for
    each time that the policy is meant to play a chunk."""
    stick_rate: Annotated[float, hidden("rates.stick")] = 100.0
    """Stick commands a second that leave for the autopilot, whatever the policy's rate."""
    realtime: Annotated[bool, hidden("scheduling.realtime")] = True
    """Real-time scheduling (SCHED_FIFO) of the guard and of the policy, where the system permits
    it."""
    guard_cpu: Annotated[int | None, hidden("scheduling.guard-cpu")] = None
    """Run the guard on this CPU alone."""
    action_cpu: Annotated[int | None, hidden("scheduling.action-cpu")] = None
    """Run the policy on this CPU alone."""
    vision_cpu: Annotated[int | None, hidden("scheduling.vision-cpu")] = None
    """Run the vision loop on this CPU alone."""

    def __post_init__(self) -> None:
        """Refuse rates that no autopilot serves."""
        low_hz, high_hz = self.visual_limits_hz
        check_range("rates.visual", low_hz, 0.5, high_hz, "Hz")
        check_range("rates.visual", high_hz, low_hz, 240, "Hz")
        for name, rate_hz in (("rates.action", self.action_rate), ("rates.single", self.rate)):
            if rate_hz is not None:
                check_range(name, rate_hz, LEAST_HZ, 500, "Hz")
        check_range("rates.stick", self.stick_rate, 20, 400, "Hz")

    @property
    def visual_limits_hz(self) -> tuple[float, float]:
        """Least and most frames a second; equal where the rate is fixed."""
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
        """Rates of both loops of a policy that plays each chunk for up to ``play_s``.

        Without dual rate images are only resized as they come. A chunk takes the newest one, so
        they come at the visual rate where chunks are slower: it must not be old when it is used.
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
