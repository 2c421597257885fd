"""Stick post-processing in continuous time: clip, slew limit, low-pass. The same at any rate."""

import math
from dataclasses import dataclass

from mavbridge.core.clock import NS_PER_S
from mavbridge.core.vehicle import NEUTRAL, ActionTrace, Sticks


@dataclass(frozen=True, slots=True, kw_only=True)
class Smoothing:
    """Settings of the filter."""

    max_slew_per_s: float
    """Largest stick movement in 1/s (full scale is 2); 0 = no limit."""
    tau_s: float
    """Time constant of the first-order low-pass; 0 = off."""
    max_dt_s: float = 0.15
    """Longest step to integrate over, s, so that the sticks do not jump after a stall; longer than
    any period."""


class StickSmoother:
    """Clip -> slew -> low-pass, with the measured time between calls.

    - Slew: the output moves towards the input by ``max_slew * dt`` at most.
    - Low-pass: ``tau dy/dt = u - y``, solved (not stepped) for an input linear over the step:
      ``y1 = u1 - m tau + (y0 - u0 + m tau) exp(-dt/tau)`` with ``m = (u1 - u0) / dt``. That makes
      the output at the tick times independent of where the ticks fall.

    Slewing comes first, so that the low-pass, an average of slewed values, keeps the bound.
    """

    def __init__(self, settings: Smoothing) -> None:
        self._settings = settings
        self._last_ns: int | None = None
        self._slewed = NEUTRAL
        self._smoothed = NEUTRAL

    def reset(self, start: Sticks) -> None:
        """Restart from the present stick positions."""
        self._last_ns = None
        self._slewed = start
        self._smoothed = start

    def step(self, raw: Sticks, now_ns: int) -> ActionTrace:
        """Filter one action, which must be finite; the first after a reset spans no time."""
        dt_s = 0.0
        if self._last_ns is not None:
            dt_s = min(max(now_ns - self._last_ns, 0) / NS_PER_S, self._settings.max_dt_s)
        self._last_ns = now_ns
        clipped = Sticks(*[min(max(value, -1.0), 1.0) for value in raw])
        before = self._slewed
        slewed = self._slew(clipped, dt_s)
        smoothed = self._low_pass(before, slewed, dt_s)
        self._slewed, self._smoothed = slewed, smoothed
        return ActionTrace(raw=raw, clipped=clipped, slewed=slewed, smoothed=smoothed)

    def _slew(self, target: Sticks, dt_s: float) -> Sticks:
        limit = self._settings.max_slew_per_s
        if limit == 0:
            return target
        reach = limit * dt_s
        pairs = zip(self._slewed, target, strict=True)
        return Sticks(*[now + min(max(goal - now, -reach), reach) for now, goal in pairs])

    def _low_pass(self, u0: Sticks, u1: Sticks, dt_s: float) -> Sticks:
        tau_s = self._settings.tau_s
        if tau_s == 0:
            return u1
        if dt_s == 0:
            return self._smoothed
        decay = math.exp(-dt_s / tau_s)
        lag = tau_s / dt_s
        return Sticks(
            *[
                b - (b - a) * lag + (y - a + (b - a) * lag) * decay
                for a, b, y in zip(u0, u1, self._smoothed, strict=True)
            ]
        )
