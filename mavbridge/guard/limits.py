"""Bounds and filter of the actions to send; neutral, idle and first actions."""

import math
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

from mavbridge.core.clock import NS_PER_S
from mavbridge.core.rotation import heading_rad, roll_pitch_rad
from mavbridge.core.vehicle import (
    IDLE,
    NEUTRAL,
    Action,
    ActionMeaning,
    ActionTrace,
    AttitudeThrust,
    BodyRates,
    Sticks,
    Telemetry,
    Velocity,
)

Four: TypeAlias = tuple[float, float, float, float]

MOST_FIRST_LEAN_RAD = math.radians(80.0)
"""Largest lean at the start of a flight, roll and pitch combined: the widest settable limit, and
below the codec's limit of 85 degrees."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ActionLimits:
    """Bounds of the four numbers of an action, and of their rates of change."""

    low: Four
    high: Four
    change_per_s: Four
    """Maximum rate of change of each; infinite: no limit."""
    pair: tuple[int, int] | None = None
    """Indices of a vector's two numbers; limits its length to ``high`` and keeps its direction."""

    def clip(self, action: Action) -> Action:
        """Return the nearest action within the bounds."""
        bounds = zip(action, self.low, self.high, strict=True)
        values = [min(max(value, low), high) for value, low, high in bounds]
        if self.pair is not None:
            self._shorten(values, list(action), self.high[self.pair[0]])
        return type(action)(*values)

    def approach(self, now: Action, goal: Action, dt_s: float) -> Action:
        """Return the action nearest to ``goal`` that the rate limits allow after ``dt_s``."""
        reach = [rate * dt_s if rate < math.inf else rate for rate in self.change_per_s]
        moves = [min(max(b - a, -most), most) for a, b, most in zip(now, goal, reach, strict=True)]
        if self.pair is not None:
            wanted = [b - a for a, b in zip(now, goal, strict=True)]
            self._shorten(moves, wanted, reach[self.pair[0]])
        return type(goal)(  # ``now`` may be an attitude: the idle action of body rates
            *[
                b if most == math.inf else a + move
                for a, b, move, most in zip(now, goal, moves, reach, strict=True)
            ]
        )

    def _shorten(self, values: list[float], vector: list[float], longest: float) -> None:
        """Copy the pair of ``vector`` into ``values``, shortened to at most ``longest``."""
        assert self.pair is not None
        one, other = self.pair
        length = math.hypot(vector[one], vector[other])
        scale = longest / length if length > longest else 1.0
        values[one], values[other] = scale * vector[one], scale * vector[other]


def neutral_action(meaning: ActionMeaning) -> Action:
    """Return the action for level flight or standstill.

    For body rates it is an attitude, since zero rates would keep a lean.
    """
    return _level_action(meaning, NEUTRAL, meaning.hover_thrust)


def idle_action(meaning: ActionMeaning) -> Action:
    """Return the action that keeps an armed vehicle on the ground."""
    return _level_action(meaning, IDLE, 0.0)


def _level_action(meaning: ActionMeaning, sticks: Sticks, thrust: float) -> Action:
    match meaning.kind:
        case "sticks":
            return sticks
        case "velocity":
            return Velocity(0.0, 0.0, 0.0, 0.0)
        case _:
            return AttitudeThrust(thrust, 0.0, 0.0, 0.0)


def first_action(meaning: ActionMeaning, telemetry: Telemetry, pilot: Sticks | None) -> Action:
    """Return the policy's first action: it continues the vehicle's motion without a jump.

    ``pilot``: sticks that the vehicle follows now; None: unknown.
    """
    attitude, velocity = telemetry.ned_from_body_wxyz, telemetry.velocity_ned_mps
    ned_from_body_wxyz = attitude.values if attitude else (1.0, 0.0, 0.0, 0.0)
    match meaning.kind:
        case "sticks":
            return pilot or NEUTRAL
        case "rates":
            return BodyRates(meaning.hover_thrust, 0.0, 0.0, 0.0)
        case "attitude":
            roll_rad, pitch_rad = roll_pitch_rad(ned_from_body_wxyz)
            share = MOST_FIRST_LEAN_RAD / max(math.hypot(roll_rad, pitch_rad), MOST_FIRST_LEAN_RAD)
            return AttitudeThrust(meaning.hover_thrust, share * roll_rad, share * pitch_rad, 0.0)
        case "velocity":
            north, east, down = velocity.values if velocity else (0.0, 0.0, 0.0)
            if meaning.is_heading_frame:
                yaw_rad = heading_rad(ned_from_body_wxyz)
                cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
                north, east = cos * north + sin * east, cos * east - sin * north
            return Velocity(north, east, down, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Smoothing:
    """Settings of the filter."""

    limits: ActionLimits
    tau_s: float
    """Time constant of the first-order low-pass; 0: off."""
    max_dt_s: float = 0.15
    """Longest integration step [s], longer than any period; prevents a jump after a stall."""


class FilterState(NamedTuple):
    """State of the filter after a step."""

    stepped_ns: int | None
    """Time of the step; None: none since the reset."""
    slewed: Action
    smoothed: Action


class ActionSmoother:
    """Filter: clip, then rate limit, then low-pass, over the measured time between calls.

    - Rate limit: the output moves towards the input by at most ``change_per_s * dt``.
    - Low-pass: ``tau dy/dt = u - y``, solved (not stepped) for an input linear over the step:
      ``y1 = u1 - m tau + (y0 - u0 + m tau) exp(-dt/tau)`` with ``m = (u1 - u0) / dt``. The
      output at a tick is therefore independent of where the earlier ticks fall.

    The rate limit comes first: the low-pass averages limited values, so it keeps the bound.
    """

    def __init__(self, settings: Smoothing, start: Action) -> None:
        self._settings = settings
        self.limits = settings.limits
        self.reset(start)

    def reset(self, start: Action) -> None:
        """Reset the filter to the vehicle's current command."""
        self.state = FilterState(None, start, start)

    def step(self, raw: Action, now_ns: int) -> ActionTrace:
        """Filter one finite action; the first step after a reset has zero duration."""
        dt_s, before = 0.0, self.state
        if before.stepped_ns is not None:
            dt_s = min(max(now_ns - before.stepped_ns, 0) / NS_PER_S, self._settings.max_dt_s)
        clipped = self.limits.clip(raw)
        slewed = self.limits.approach(before.slewed, clipped, dt_s)
        smoothed = self._low_pass(before, slewed, dt_s)
        self.state = FilterState(now_ns, slewed, smoothed)
        return ActionTrace(raw=raw, clipped=clipped, slewed=slewed, smoothed=smoothed)

    def _low_pass(self, before: FilterState, u1: Action, dt_s: float) -> Action:
        tau_s = self._settings.tau_s
        if tau_s == 0:
            return u1
        if dt_s == 0:
            return type(u1)(*before.smoothed)
        decay = math.exp(-dt_s / tau_s)
        lag = tau_s / dt_s
        filtered = (
            (a, b, y, b - (b - a) * lag + (y - a + (b - a) * lag) * decay)
            for a, b, y in zip(before.slewed, u1, before.smoothed, strict=True)
        )
        # An average of the three: rounding must not carry it beyond their bounds.
        return type(u1)(*[min(max(z, min(a, b, y)), max(a, b, y)) for a, b, y, z in filtered])
