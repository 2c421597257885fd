"""Step response of one axis: actions sent, motion of the vehicle, and a fit to both."""

import math
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mavbridge.core.clock import NS_PER_S
from mavbridge.core.records import Event, Tick, VehicleState
from mavbridge.core.vehicle import Action
from policy.contract import RATE, ActionKind, FloatArray
from policy.motion.controllers import Axis, measure

Array = NDArray[np.float64]
Sides = tuple[float, float]
"""Value for the positive side, value for the negative side."""
MAX_ROWS = 100_000
"""Most actions, and most states: four minutes at 400 Hz. The oldest are dropped first."""
STEP_S, LEAD_S = 0.005, 1.1
"""Grid of the fit, and the span of input used before the first output."""
DEAD_TIMES_S, LAGS_S = np.arange(0.0, 0.601, 0.02), np.geomspace(0.01, 1.5, 36)
FINE_DEAD_S, FINE_LAG = np.arange(-0.02, 0.0201, 0.004), np.geomspace(0.85, 1.18, 21)
OUTLIER_MADS, LEAST_SAMPLES = 6.0, 20
SETTLED = 0.1
"""A push has settled if its last two eighths differ by at most this share of the whole."""
_DEG = math.degrees(1.0)
UNITS = {
    "lean": ("deg", "attitude_ns"),
    "rate": ("deg/s", "rate_ns"),
    "speed": ("m/s", "velocity_ns"),
}
"""Unit of each motion, and the field of a state with its measurement time."""


class Channel(NamedTuple):
    """One axis: a number of the action, and the resulting motion."""

    axis: Axis
    column: int
    scale: float
    """Factor from the number of the action to the motion's unit, or to shares of full stick."""
    motion: Literal["lean", "rate", "speed"]
    read: Callable[[FloatArray], float]
    """Returns the motion in a 13-D state: + is right, forward, nose right, up."""


_ROLL = partial(Channel, "roll", motion="lean", read=lambda values: _DEG * measure(values).roll_rad)
_PITCH = partial(
    Channel, "pitch", motion="lean", read=lambda values: -_DEG * measure(values).pitch_rad
)
_YAW = partial(Channel, "yaw", motion="rate", read=lambda values: _DEG * float(values[RATE][2]))
_CLIMB = partial(Channel, "climb", motion="speed", read=lambda values: measure(values).climb_mps)
CHANNELS: dict[ActionKind, tuple[Channel, ...]] = {
    "sticks": (_ROLL(3, 1.0), _PITCH(2, 1.0), _YAW(1, 1.0), _CLIMB(0, 1.0)),
    "attitude": (_ROLL(1, _DEG), _PITCH(2, -_DEG), _YAW(3, _DEG)),
    "rates": (
        Channel("roll", 1, _DEG, "rate", lambda values: _DEG * float(values[RATE][0])),
        Channel("pitch", 2, -_DEG, "rate", lambda values: -_DEG * float(values[RATE][1])),
        _YAW(3, _DEG),
    ),
    "velocity": (
        Channel("roll", 1, 1.0, "speed", lambda values: measure(values).right_mps),
        Channel("pitch", 0, 1.0, "speed", lambda values: measure(values).forward_mps),
        _YAW(3, _DEG),
        _CLIMB(2, -1.0),
    ),
}
"""Axes pushed by the doublet of each kind of action."""


class ResponseRecording:
    """``TickSink`` that keeps the policy's actions and the states that they are based on."""

    def __init__(self) -> None:
        self._sent: deque[tuple[int, Action]] = deque(maxlen=MAX_ROWS)
        self._states: deque[VehicleState] = deque(maxlen=MAX_ROWS)

    def emit(self, event: Event) -> None:
        """Keep a tick in which the policy flew; see ``mavbridge.core.ports.TickSink``."""
        if not isinstance(event, Tick) or event.trace is None:
            return
        # The policy's action after its limits, before any mapping to this vehicle's curves.
        self._sent.append((event.sent_ns, event.trace.smoothed))
        state = event.state
        if state is not None and (not self._states or state is not self._states[-1]):
            self._states.append(state)

    def inputs(self, column: int) -> tuple[Array, Array]:
        """Return times in s and values of one number of the actions."""
        times = np.array([at_ns for at_ns, _ in self._sent], np.float64) / NS_PER_S
        return times, np.array([action[column] for _, action in self._sent], np.float64)

    def outputs(self, channel: Channel) -> tuple[Array, Array]:
        """Return times in s and values of a motion, without repeated times."""
        _, stamp = UNITS[channel.motion]
        times = np.array([getattr(state, stamp) for state in self._states], np.int64)
        values = np.array([channel.read(state.values) for state in self._states], np.float64)
        _, first = np.unique(times, return_index=True)
        return times[first].astype(np.float64) / NS_PER_S, values[first]


class Response(NamedTuple):
    """Dead time, then a first-order lag. Gains are output per unit of input."""

    gains: Sides
    dead_time_s: float
    lag_s: float
    r_squared: float
    """Share of the output's variance that the model explains."""


def fit_response(
    input_s: Array, inputs: Array, output_s: Array, outputs: Array, gains: Sides | None = None
) -> Response | None:
    """Fit ``output = offset + gain * lag(input, dead_time earlier)``, with a gain for each sign.

    Times rise and are in s; an input holds until the next. Samples far off the first fit, such as
    those of a gust, are left out of a second one. Return None if there is too little data.
    """
    if len(input_s) < 2 or len(output_s) < LEAST_SAMPLES or np.ptp(outputs) == 0.0:
        return None
    grid_s = np.arange(output_s[0] - LEAD_S, output_s[-1] + STEP_S, STEP_S)
    held = inputs[np.clip(np.searchsorted(input_s, grid_s, side="right") - 1, 0, None)]
    signs = np.stack([np.maximum(held, 0.0), np.minimum(held, 0.0)], axis=-1)

    def best(
        kept: NDArray[np.bool_], dead_times_s: Array, lags_s: Array
    ) -> tuple[float, Response, Array]:
        share = (1.0 - np.exp(-STEP_S / lags_s))[:, None]
        lagged = np.zeros((len(signs), len(lags_s), 2))
        for index, now in enumerate(signs[:-1]):  # a sample takes effect from its own time on
            lagged[index + 1] = lagged[index] + share * (now - lagged[index])
        found = []
        for dead_s in dead_times_s.tolist():
            for number, lag_s in enumerate(lags_s.tolist()):
                at_s = output_s - dead_s
                up, down = (np.interp(at_s, grid_s, lagged[:, number, sign]) for sign in (0, 1))
                table = np.stack([up, down, np.ones(len(at_s))], axis=-1)
                if gains is None:
                    weights = np.linalg.lstsq(table[kept], outputs[kept], rcond=None)[0]
                else:
                    offset = (outputs - table[:, :2] @ gains)[kept].mean()
                    weights = np.array([*gains, offset])
                missed = outputs - table @ weights
                explained = 1.0 - float(np.square(missed).mean() / outputs.var())
                response = Response((weights[0], weights[1]), dead_s, lag_s, explained)
                found.append((float(np.square(missed[kept]).sum()), response, missed))
        return min(found, key=lambda each: each[0])

    _, coarse, missed = best(np.ones(len(outputs), bool), DEAD_TIMES_S, LAGS_S)
    kept = np.abs(missed) <= max(OUTLIER_MADS * float(np.median(np.abs(missed))), 1e-9)
    if kept.sum() < LEAST_SAMPLES:
        return None
    dead_times_s = np.unique(np.clip(coarse.dead_time_s + FINE_DEAD_S, 0.0, None))
    return best(kept, dead_times_s, coarse.lag_s * FINE_LAG)[1]


def settled_gain(
    input_s: Array, inputs: Array, output_s: Array, outputs: Array, end_s: float, half_s: float
) -> float | None:
    """Return the motion per unit of a push, from its last eighth; None if it has not settled.

    A fit alone errs where acceleration is limited: full yaw rate by 10 %, full climb by 14 %
    (bundled ArduPilot).
    """
    begin_s, middle_s = end_s - 0.25 * half_s, end_s - 0.125 * half_s
    pushed = inputs[(input_s >= begin_s) & (input_s < end_s)]
    first = outputs[(output_s >= begin_s) & (output_s < middle_s)]
    second = outputs[(output_s >= middle_s) & (output_s < end_s)]
    if min(len(pushed), len(first), len(second)) < 2:
        return None
    push, earlier, later = (float(np.median(values)) for values in (pushed, first, second))
    if np.ptp(pushed) > SETTLED * abs(push) or abs(later - earlier) > SETTLED * abs(later):
        return None
    return later / push
