"""Step response of one axis by least squares, and the recording that it is fitted to."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mavbridge.core.clock import NS_PER_S
from mavbridge.core.records import Event, Tick, VehicleState
from mavbridge.core.vehicle import Action

Array = NDArray[np.float64]

STEP_S = 0.005
LEAD_S = 0.5
"""Time of the input before the first output: what the output still remembers."""
DEAD_TIMES_S = np.arange(0.0, 0.601, 0.02)
LAGS_S = np.geomspace(0.01, 1.5, 36)
FINE_DEAD_S = np.arange(-0.02, 0.0201, 0.002)
FINE_LAG = np.geomspace(0.85, 1.18, 21)
OUTLIER_SIGMAS = 4.0
SIGMA_PER_MAD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""
LEAST_SAMPLES = 20
MAX_ROWS = 100_000
"""Most actions, and most states: four minutes at 400 Hz. Beyond it the oldest are forgotten."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Response:
    """Dead time, then a lag of first order."""

    gain_up: float
    """Output for each unit of input where the input is positive."""
    gain_down: float
    """Where it is negative; of the same sign as ``gain_up`` on a usual vehicle."""
    dead_time_s: float
    lag_s: float
    r_squared: float
    """Share of the output's variance that the model explains."""

    @property
    def time_63_s(self) -> float:
        """From a step of the input to 63 % of its effect."""
        return self.dead_time_s + self.lag_s


def fit_response(
    input_s: Array,
    inputs: Array,
    output_s: Array,
    outputs: Array,
    *,
    gains: tuple[float, float] | None = None,
) -> Response | None:
    """Fit ``output = offset + gain * lag(input, dead_time earlier)``, with a gain for each sign.

    Any input will do that moves the output, also one that a feedback has made. Samples that the
    first fit misses by far, such as those of a gust, are left out of a second one.

    Args:
        input_s: [n] rising times in s.
        inputs: [n], each held until the next.
        output_s: [m] rising times in s, on the same clock.
        outputs: [m].
        gains: of positive and of negative inputs, where they are known already.

    Returns:
        None where there is too little to fit.
    """
    if len(input_s) < 2 or len(output_s) < LEAST_SAMPLES or np.ptp(outputs) == 0.0:
        return None
    first = _Grid(input_s, inputs, output_s, outputs, gains)
    coarse = first.best(DEAD_TIMES_S, LAGS_S)
    residual = np.abs(outputs - first.output(coarse))
    most = OUTLIER_SIGMAS * SIGMA_PER_MAD * np.median(residual)
    kept = residual <= max(most, 1e-9)
    if kept.sum() < LEAST_SAMPLES:
        return None
    grid = _Grid(input_s, inputs, output_s[kept], outputs[kept], gains)
    dead_times_s = np.clip(coarse.dead_time_s + FINE_DEAD_S, 0.0, None)
    fine = grid.best(np.unique(dead_times_s), coarse.lag_s * FINE_LAG)
    error = float(np.square(outputs - grid.output(fine, output_s)).sum())
    return Response(
        gain_up=fine.weights[0],
        gain_down=fine.weights[1],
        dead_time_s=fine.dead_time_s,
        lag_s=fine.lag_s,
        r_squared=1.0 - error / float(np.square(outputs - outputs.mean()).sum()),
    )


@dataclass(frozen=True, slots=True)
class _Candidate:
    dead_time_s: float
    lag_s: float
    weights: tuple[float, float, float]
    """Gain up, gain down, offset."""


class _Grid:
    """The input on a uniform grid of time, and the outputs that it is to explain."""

    def __init__(
        self,
        input_s: Array,
        inputs: Array,
        output_s: Array,
        outputs: Array,
        gains: tuple[float, float] | None,
    ) -> None:
        self._begin_s = float(output_s[0]) - LEAD_S - float(DEAD_TIMES_S[-1])
        times_s = np.arange(self._begin_s, float(output_s[-1]) + STEP_S, STEP_S)
        newest = np.searchsorted(input_s, times_s, side="right") - 1
        held = inputs[np.clip(newest, 0, None)]
        self._inputs = np.stack([np.maximum(held, 0.0), np.minimum(held, 0.0)], axis=-1)
        self._output_s, self._outputs = output_s, outputs
        self._gains = gains

    def best(self, dead_times_s: Array, lags_s: Array) -> _Candidate:
        """The pair of dead time and lag whose best gains leave the least error."""
        lagged = self._lagged(lags_s)
        best, least = None, np.inf
        for dead_time_s in dead_times_s:
            columns = self._columns(lagged, float(dead_time_s), self._output_s)
            weights = self._weights(columns)
            errors = np.square(self._outputs - np.einsum("lmk,lk->lm", columns, weights)).sum(1)
            index = int(errors.argmin())
            if errors[index] < least:
                least = errors[index]
                up, down, offset = (float(weight) for weight in weights[index])
                best = _Candidate(float(dead_time_s), float(lags_s[index]), (up, down, offset))
        assert best is not None
        return best

    def output(self, candidate: _Candidate, at_s: Array | None = None) -> Array:
        """[m] as the candidate has it, at the times of the outputs or others within them."""
        lagged = self._lagged(np.array([candidate.lag_s]))
        times_s = self._output_s if at_s is None else at_s
        columns = self._columns(lagged, candidate.dead_time_s, times_s)
        output: Array = columns[0] @ np.array(candidate.weights)
        return output

    def _weights(self, columns: Array) -> Array:
        """[lags, 3] that leave the least error: both gains, where they are free, and the offset."""
        if self._gains is None:
            weights: Array = np.linalg.pinv(columns) @ self._outputs
            return weights
        known = np.broadcast_to(np.array(self._gains), (len(columns), 2))
        offset = (self._outputs - np.einsum("lmk,lk->lm", columns[..., :2], known)).mean(axis=1)
        return np.concatenate([known, offset[:, None]], axis=1)

    def _lagged(self, lags_s: Array) -> Array:
        """[grid, lags, 2]: both signs of the input behind each lag, from rest."""
        share = (1.0 - np.exp(-STEP_S / lags_s))[:, None]
        value = np.zeros((len(lags_s), 2))
        lagged = np.empty((len(self._inputs), len(lags_s), 2))
        for index, now in enumerate(self._inputs):
            lagged[index] = value  # a sample acts from its own moment on
            value = value + share * (now - value)
        return lagged

    def _columns(self, lagged: Array, dead_time_s: float, at_s: Array) -> Array:
        """[lags, m, 3]: regressors at these times, so much later, and ones."""
        position = (at_s - dead_time_s - self._begin_s) / STEP_S
        low = np.clip(position.astype(int), 0, len(lagged) - 2)
        weight = (position - low)[:, None, None]
        at = (1.0 - weight) * lagged[low] + weight * lagged[low + 1]
        ones = np.ones((*at.shape[:2], 1))
        columns: Array = np.concatenate([at, ones], axis=-1).transpose(1, 0, 2)
        return columns


class ResponseRecording:
    """A sink of ticks that keeps the policy's actions and the states that they came from.

    One thread emits; the rest is for after the flight.
    """

    def __init__(self) -> None:
        self._sent: deque[tuple[int, Action]] = deque(maxlen=MAX_ROWS)
        self._states: deque[VehicleState] = deque(maxlen=MAX_ROWS)

    def emit(self, event: Event) -> None:
        """Keep a tick in which the policy flew; see ``mavbridge.core.ports.TickSink``."""
        if not isinstance(event, Tick) or event.trace is None:
            return
        # As the policy's after its limits, before any mapping to this vehicle's own curves.
        self._sent.append((event.sent_ns, event.trace.smoothed))
        state = event.state
        if state is not None and (not self._states or state is not self._states[-1]):
            self._states.append(state)

    def inputs(self, column: int) -> tuple[Array, Array]:
        """Times in s and values of one number of the actions."""
        times = np.array([at_ns for at_ns, _ in self._sent], np.float64) / NS_PER_S
        return times, np.array([action[column] for _, action in self._sent], np.float64)

    def outputs(
        self, read: Callable[[VehicleState], float], measured_ns: Callable[[VehicleState], int]
    ) -> tuple[Array, Array]:
        """Times in s and values of something that ``read`` finds in a state; each moment once."""
        times = np.array([measured_ns(state) for state in self._states], np.int64)
        values = np.array([read(state) for state in self._states], np.float64)
        _, first = np.unique(times, return_index=True)
        return times[first].astype(np.float64) / NS_PER_S, values[first]
