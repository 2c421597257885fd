"""Every rate of the flight in Hz, and the only place that holds one."""

import math
from dataclasses import dataclass
from typing import Annotated

from cyclopts import Parameter

from mavbridge.config.checks import check_range
from mavbridge.config.groups import RARE, RATES
from mavbridge.core.errors import UserError

AUTO_VISUAL_HZ = (10.0, 60.0)
"""Limits of --visual-rate auto where none are given."""
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

    visual_rate: float | str = 30.0
    """Most frames a second through the image encoder (dual rate); auto[:MIN:MAX] encodes more often
    when the vehicle turns or the image changes."""
    action_rate: float = 100.0
    """Most chunks of actions a second, each from the newest attitude (dual rate)."""
    rate: float = 30.0
    """The same in single-rate mode, each with the newest image."""
    stick_rate: float = 100.0
    """Stick commands a second that leave for the autopilot, whatever the policy's rate."""
    realtime: Annotated[bool, Parameter(group=RARE)] = True
    """Real-time scheduling (SCHED_FIFO) of the gate and of the policy, where the system permits
    it."""
    gate_cpu: Annotated[int | None, Parameter(group=RARE)] = None
    """Run the gate on this CPU alone."""
    action_cpu: Annotated[int | None, Parameter(group=RARE)] = None
    """Run the policy on this CPU alone."""
    vision_cpu: Annotated[int | None, Parameter(group=RARE)] = None
    """Run the vision loop on this CPU alone."""

    def __post_init__(self) -> None:
        """Refuse rates that no autopilot serves."""
        low_hz, high_hz = self.visual_limits_hz
        check_range("visual-rate", low_hz, 0.5, high_hz, "Hz")
        check_range("visual-rate", high_hz, low_hz, 240, "Hz")
        check_range("action-rate", self.action_rate, 0.5, 500, "Hz")
        check_range("rate", self.rate, 0.5, 500, "Hz")
        check_range("stick-rate", self.stick_rate, 20, 400, "Hz")

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
                f"--visual-rate {self.visual_rate} is neither a rate in Hz nor auto[:MIN:MAX]"
            )
        return low_hz, high_hz

    def loops(self, *, is_dual: bool) -> LoopRates:
        """Rates of both loops; without dual rate each action has an image of its own."""
        min_hz, max_hz = self.visual_limits_hz if is_dual else (self.rate, self.rate)
        action_hz = self.action_rate if is_dual else self.rate
        return LoopRates(action_hz=action_hz, min_vision_hz=min_hz, max_vision_hz=max_hz)
