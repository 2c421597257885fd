"""A policy in numpy: climbs to 2.8 m above home and turns on the spot.

make fly POLICY=./examples/numpy_policy.py:ClimbAndTurn DURATION=20
"""

import numpy as np

from policy.contract import Contract


class ClimbAndTurn:
    contract = Contract(arrays="numpy", state_extras=("height",), horizon=16)

    def predict(self, image, state, action_history, num_diffusion_steps):
        chunk = np.zeros((1, 16, 4), np.float32)  # throttle, yaw, pitch, roll in [-1, 1]
        chunk[..., 0] = np.clip(3.0 - state[0, -1], -0.5, 0.5)  # the height is the last number
        chunk[..., 1] = 0.2  # nose to the right
        return chunk
