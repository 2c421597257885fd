"""The policy of the golden flights ``numpy_*``: additions, products and limits of float32, element
by element, so that its chunks are the same bits on every processor.

It looks at two observations, takes the motion since the exposure, and keeps a chunk between calls,
so that a replay has to repeat all of that.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from policy.contract import Contract

FloatArray = NDArray[np.float32]
CONTRACT = Contract(
    feature_dim=4,
    arrays="numpy",
    history_len=3,
    history_dt_s=0.05,
    observation_steps=2,
    observation_dt_s=0.1,
    since_exposure=True,
    horizon=8,
)


class NumpyPolicy:
    """Climbs, and leans a little with what it sees."""

    def __init__(self) -> None:
        self.contract = CONTRACT
        self._last = np.zeros((1, CONTRACT.horizon, 4), np.float32)

    def reset(self) -> None:
        """Forget the last chunk."""
        self._last = np.zeros_like(self._last)

    def encode_visual(self, image: FloatArray) -> FloatArray:
        """[1, 3, H, W] -> [1, 4]: four pixels."""
        _, _, height, width = image.shape
        rows, columns = (height // 4, height // 2), (width // 4, width // 2)
        return np.array([[image[0, 1, y, x] for y in rows for x in columns]], np.float32)

    def predict(
        self, image: FloatArray, state: FloatArray, action_history: FloatArray, steps: int
    ) -> FloatArray:
        """Both halves."""
        feature = np.stack([self.encode_visual(image[:, k]) for k in range(2)], axis=1)
        return self.predict_fast(feature, state, action_history, steps)

    def predict_fast(
        self, feature: FloatArray, state: FloatArray, action_history: FloatArray, steps: int
    ) -> FloatArray:
        """Features [1, 2, 4], states [1, 2, S], history [1, 3, 4] -> [1, 8, 4]."""
        f32 = np.float32
        seen = np.clip(feature[0, 1] * f32(0.02) + feature[0, 0] * f32(0.01), f32(-0.05), f32(0.05))
        moved = np.clip(state[0, 1, :4] - state[0, 0, :4], f32(-1), f32(1)) * f32(0.05)
        since = np.clip(state[0, 1, -4:], f32(-1), f32(1)) * f32(0.02)
        goal = np.array([0.4, 0.05, 0.05, -0.05], np.float32) - moved + seen + since
        goal = goal * f32(0.75) + action_history[0, -1] * f32(0.25)
        chunk = np.zeros_like(self._last)
        for k in range(CONTRACT.horizon):
            chunk[0, k] = self._last[0, k] * f32(0.5) + goal * f32(0.5 + 0.03125 * k)
        self._last = np.clip(chunk, f32(-0.6), f32(0.6))
        return self._last.copy()
