"""Policy of the link test, flown by mavbridge itself: the roll stick repeats the roll rate."""

from typing import Any

import numpy as np

from policy.contract import ACTION_DIM, ACTION_NAMES, RATE, Contract

ROLL = ACTION_NAMES.index("roll")


class RollRate:
    """Answers each attitude; its encoder and its head take no time."""

    # Wide age limits, so that a vehicle served late is measured.
    contract = Contract(
        arrays="numpy",
        feature_dim=1,
        image_height=32,
        image_width=32,
        max_state_age_s=1.0,
        max_velocity_age_s=1.0,
        max_chunk_age_s=1.0,
    )

    def encode_visual(self, image: Any) -> Any:
        """Return an empty feature [1, 1]."""
        return np.zeros((1, 1), np.float32)

    def predict_fast(self, feature: Any, state: Any, action_history: Any, steps: int) -> Any:
        """Return a chunk [1, 16, 4] whose roll stick is the roll rate [rad/s] of the state."""
        chunk = np.zeros((1, Contract.horizon, ACTION_DIM), np.float32)
        chunk[..., ROLL] = state[0, RATE][0]
        return chunk

    def predict(self, image: Any, state: Any, action_history: Any, steps: int) -> Any:
        """Return the same chunk."""
        return self.predict_fast(None, state, action_history, steps)
