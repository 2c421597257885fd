"""Post-processing of actions in continuous time: clip, limit of change, low-pass; at any rate."""

import math
from dataclasses import dataclass

from mavbridge.core.clock import NS_PER_S
from mavbridge.core.vehicle import Action, ActionTrace
from mavbridge.guard.limits import ActionLimits


@dataclass(frozen=True, slots=True, kw_only=True)
class Smoothing:
    """Settings of the filter."""

    limits: ActionLimits
    tau_s: float
    """Time constant of the first-order low-pass; 0 = off."""
    max_dt_s: float = 0.15
    """Longest step to integrate over, s, so that nothing jumps after a stall; longer than any
    period."""


class ActionSmoother:
    """Clip -> limit of change -> low-pass, with the measured time between calls.

    - Change: the output moves towards the input by ``change_per_s * dt`` at most.
    - Low-pass: ``tau dy/dt = u - y``, solved (not stepped) for an input linear over the step:
      ``y1 = u1 - m tau + (y0 - u0 + m tau) exp(-dt/tau)`` with ``m = (u1 - u0) / dt``. That makes
      the output at the tick times independent of where the ticks fall.

    The limit comes first, so that the low-pass, an average of limited values, keeps the bound.
    """

    def __init__(self, settings: Smoothing, start: Action) -> None:
        self._settings = settings
        self.limits = settings.limits
        self._last_ns: int | None = None
        self._slewed = start
        self._smoothed = self._before = start

    def reset(self, start: Action) -> None:
        """Restart from what the vehicle does at present."""
        self._last_ns = None
        self._slewed = start
        self._smoothed = self._before = start

    def undo(self) -> None:
        """Restart from before the last step, whose output did not leave."""
        self.reset(self._before)

    def step(self, raw: Action, now_ns: int) -> ActionTrace:
        """Filter one action, which must be finite; the first after a reset spans no time."""
        dt_s = 0.0
        if self._last_ns is not None:
            dt_s = min(max(now_ns - self._last_ns, 0) / NS_PER_S, self._settings.max_dt_s)
        self._last_ns = now_ns
        clipped = self.limits.clip(raw)
        before = self._slewed
        slewed = self.limits.approach(before, clipped, dt_s)
        smoothed = self._low_pass(before, slewed, dt_s)
        self._before = self._smoothed
        self._slewed, self._smoothed = slewed, smoothed
        return ActionTrace(raw=raw, clipped=clipped, slewed=slewed, smoothed=smoothed)

    def _low_pass(self, u0: Action, u1: Action, dt_s: float) -> Action:
        tau_s = self._settings.tau_s
        if tau_s == 0:
            return u1
        if dt_s == 0:
            return type(u1)(*self._smoothed)
        decay = math.exp(-dt_s / tau_s)
        lag = tau_s / dt_s
        filtered = (
            (a, b, y, b - (b - a) * lag + (y - a + (b - a) * lag) * decay)
            for a, b, y in zip(u0, u1, self._smoothed, strict=True)
        )
        # An average of the three: rounding must not carry it beyond a limit that they keep.
        return type(u1)(*[min(max(z, min(a, b, y)), max(a, b, y)) for a, b, y, z in filtered])
