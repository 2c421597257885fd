"""Policies as a user might write them, with what can go wrong in them."""

import time

import numpy as np
from numpy.typing import NDArray

from policy.contract import Contract

Array = NDArray[np.float32]


class Climbing:
    """Climbs; the smallest dual-rate policy there is."""

    contract = Contract(arrays="numpy", feature_dim=1)

    def __init__(self) -> None:
        self._calls = 0

    def encode_visual(self, image: Array) -> Array:
        return np.zeros((1, 1), dtype=np.float32)

    def predict_fast(
        self, feature: Array, state: Array, action_history: Array, num_diffusion_steps: int
    ) -> Array:
        self._calls += 1
        chunk = np.zeros((1, self.contract.horizon, 4), dtype=np.float32)
        chunk[..., 0] = 0.5
        return chunk

    def predict(
        self, image: Array, state: Array, action_history: Array, num_diffusion_steps: int
    ) -> Array:
        return self.predict_fast(image, state, action_history, num_diffusion_steps)


class SingleRate:
    """Climbs; has no fast path."""

    contract = Contract(arrays="numpy")

    def predict(
        self, image: Array, state: Array, action_history: Array, num_diffusion_steps: int
    ) -> Array:
        chunk = np.zeros((1, self.contract.horizon, 4), dtype=np.float32)
        chunk[..., 0] = 0.5
        return chunk


class Exploding(Climbing):
    """Fails after a second of flight."""

    def predict_fast(
        self, feature: Array, state: Array, action_history: Array, num_diffusion_steps: int
    ) -> Array:
        if self._calls > 100:
            raise RuntimeError("the user's policy is broken")
        return super().predict_fast(feature, state, action_history, num_diffusion_steps)


class Hanging(Climbing):
    """Stops answering after a second of flight, and comes back while the sticks are given back."""

    def predict_fast(
        self, feature: Array, state: Array, action_history: Array, num_diffusion_steps: int
    ) -> Array:
        if self._calls == 100:
            time.sleep(2.5)  # noqa: TID251 - the hang itself
        return super().predict_fast(feature, state, action_history, num_diffusion_steps)
