"""Adaptive visual rate: as fast as the scene moves, within what the encoder can sustain."""

import math

import numpy as np

from mavbridge.core.clock import NS_PER_S
from mavbridge.core.records import CameraImage, Event, Tick
from policy.contract import RATE

FULL_TURN_RADPS = 1.5
"""Body rate that demands the highest rate; at 10 Hz the view turns by 9 degrees per frame."""
FULL_CHANGE_PER_S = 1.0
"""Mean pixel change [full scales/s] that demands the highest rate. For depth the full scale is the
farthest pixel."""
BUDGET = 0.8
"""Share of one core that the encoder may use."""
CALM_TAU_S = 0.5
"""Time constant of a falling demand. It rises at once and falls slowly, because motion may
resume."""
_GRID = 16
"""Image change is measured on about this many pixels per side."""


class AdaptiveRate:
    """``TickSink`` that turns motion into the vision loop's next period.

    Body rates come from ticks; image change and encoding time come from vision ticks. The two
    emitting threads write different fields.
    """

    def __init__(self, *, min_hz: float, max_hz: float) -> None:
        self._min_hz = min_hz
        self._max_hz = max_hz
        self._turn_radps = 0.0
        self._demand = 1.0  # before the first measurements, the highest rate
        self._encode_s = 0.0
        self._last: tuple[int, CameraImage] | None = None

    @property
    def is_adaptive(self) -> bool:
        """True if the limits differ; otherwise no event needs to be emitted here."""
        return self._max_hz > self._min_hz

    def emit(self, event: Event) -> None:
        """Measure motion from an event."""
        if isinstance(event, Tick):
            if event.state is not None:
                self._turn_radps = math.hypot(*event.state.values[RATE].tolist())
            return
        encode_s = (event.ready_ns - event.started_ns) / NS_PER_S
        # Slower at once, faster slowly: the budget must hold for the next frame, too.
        self._encode_s = max(encode_s, self._encode_s + 0.1 * (encode_s - self._encode_s))
        height, width = event.rgb.shape[:2]
        small = event.rgb[:: max(1, height // _GRID), :: max(1, width // _GRID)]
        last, self._last = self._last, (event.captured_ns, small)
        if last is None or last[1].shape != small.shape:
            return
        gap_s = max((event.captured_ns - last[0]) / NS_PER_S, 1e-3)
        full = 255 if small.ndim == 3 else max(int(small.max()), 1)
        change_per_s = float(np.abs(small.astype(np.int32) - last[1]).mean() / full / gap_s)
        wanted = max(self._turn_radps / FULL_TURN_RADPS, change_per_s / FULL_CHANGE_PER_S)
        calmed = self._demand * math.exp(-gap_s / CALM_TAU_S)
        self._demand = max(min(1.0, wanted), calmed)

    @property
    def rate_hz(self) -> float:
        """Current encoding rate [Hz], within the limits."""
        wanted_hz = self._min_hz + self._demand * (self._max_hz - self._min_hz)
        if self._encode_s > 0:
            wanted_hz = min(wanted_hz, BUDGET / self._encode_s)
        return min(max(wanted_hz, self._min_hz), self._max_hz)

    def period_ns(self) -> int:
        """Return the time to the next frame to encode."""
        return round(NS_PER_S / self.rate_hz)
