"""A user's policy that flies for a while and then raises."""

import numpy as np
from numpy.typing import NDArray

from policy.contract import Contract


class Exploding:
    """Climbs for a second, then fails as user code does."""

    contract = Contract(arrays="numpy", feature_dim=1)

    def __init__(self) -> None:
        self._calls = 0

    def encode_visual(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.zeros((1, 1), dtype=np.float32)

    def predict_fast(
        self,
        feature: NDArray[np.float32],
        state: NDArray[np.float32],
        action_history: NDArray[np.float32],
        num_diffusion_steps: int,
    ) -> NDArray[np.float32]:
        self._calls += 1
        if self._calls > 100:
            raise RuntimeError("the user's policy is broken")
        chunk = np.zeros((1, self.contract.horizon, 4), dtype=np.float32)
        chunk[..., 0] = 0.5
        return chunk

    def predict(
        self,
        image: NDArray[np.float32],
        state: NDArray[np.float32],
        action_history: NDArray[np.float32],
        num_diffusion_steps: int,
    ) -> NDArray[np.float32]:
        return self.predict_fast(image, state, action_history, num_diffusion_steps)
