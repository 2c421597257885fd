"""Step response of one axis: actions sent, motion of the vehicle, and the figures of both."""

import math
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Literal, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from mavbridge.core.clock import NS_PER_S
from mavbridge.core.records import Event, Tick, VehicleState
from mavbridge.core.vehicle import Action
from policy.contract import RATE, ActionKind, FloatArray
from policy.motion.controllers import Axis, DoubletStep, measure

Array = NDArray[np.float64]
Sides = tuple[float, float]
"""Value for the positive side, value for the negative side."""
MAX_ROWS = 100_000
"""Most actions, and most states: four minutes at 400 Hz. The oldest are dropped first."""
EARLY_S, BEFORE_S = 0.12, 0.1
"""Time by which a push ends early because of the smoothing's lag; time used before a push."""
SETTLED = 0.1
"""A push has settled if its last two eighths differ by at most this share of the whole."""
GUST_S = 0.12
"""Disturbances up to this long are left out."""
FOLLOWS_SIGMAS = 5.0
"""Least motion, in standard deviations of that before the push, that counts as an answer."""
PARTS = (0.284, 0.632)
"""Shares of its last value that a first-order lag reaches after a third of it, and after it."""
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


def measure_response(
    input_s: Array, inputs: Array, output_s: Array, outputs: Array, step: DoubletStep
) -> Response | str:
    """Measure both gains of a doublet, and dead time and lag of its first push; or say why not.

    Times are in s since the program of the doublets began, and rise. The gains are those of the
    settled motion; times are by two points (C. L. Smith, Digital Computer Process Control, 1972),
    counted from where the smoothed input itself reached the same share.
    """
    outputs = _without_gusts(output_s, outputs)
    data, half_s = (input_s, inputs, output_s, outputs), step.half_s
    ends_s = (step.begin_s + half_s - EARLY_S, step.end_s - EARLY_S)
    up_gain, down_gain = (_settled_gain(*data, end_s, half_s) for end_s in ends_s)
    if up_gain is None or down_gain is None:
        return "the motion had not settled"
    before = outputs[(output_s >= step.begin_s - BEFORE_S) & (output_s < step.begin_s)]
    rest, shaking = (float(np.median(before)), float(before.std())) if len(before) else (0.0, 0.0)
    push = float(inputs[(input_s >= step.begin_s) & (input_s < ends_s[0])].max())
    moved = up_gain * push - rest
    if abs(moved) <= FOLLOWS_SIGMAS * shaking or abs(up_gain * push) == 0.0:
        return "the motion does not follow the action"
    third_s, whole_s = (
        _reached_s(output_s, (outputs - rest) / moved, part, step.begin_s, ends_s[0])
        - _reached_s(input_s, inputs / push, part, step.begin_s, ends_s[0])
        for part in PARTS
    )
    lag_s = min(1.5 * (whole_s - third_s), whole_s)
    return Response((up_gain, down_gain), whole_s - lag_s, lag_s)


def _without_gusts(times_s: Array, values: Array) -> Array:
    """Return running medians, which leave a rising or falling response as it is."""
    if len(times_s) < 2:
        return values
    half = round(GUST_S / float(np.median(np.diff(times_s))))
    padded = np.pad(values, half, "edge")
    return np.asarray(np.median(sliding_window_view(padded, 2 * half + 1), axis=-1))


def _reached_s(times_s: Array, shares: Array, part: float, begin_s: float, end_s: float) -> float:
    """Return when rising shares reached ``part``: in noise, between the first time and the last."""
    within = (times_s >= begin_s) & (times_s < end_s)
    times_s, is_below = times_s[within], np.append(True, shares[within] < part)
    first, last = int(is_below[1:].argmin()), int(np.flatnonzero(is_below)[-1])
    return float(times_s[first] + times_s[min(last, len(times_s) - 1)]) / 2


def _settled_gain(
    input_s: Array, inputs: Array, output_s: Array, outputs: Array, end_s: float, half_s: float
) -> float | None:
    """Return the motion per unit of a push, from its last eighth; None if it has not settled."""
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
