"""States as changes since now, and back."""

import numpy as np
import torch
from torch import Tensor

from helpers.factories import about_z
from policy.contract import QUATERNION, VELOCITY, Contract
from policy.motion import rotation
from policy.nets.world_model.motion import (
    context_features,
    motion_since,
    state_after,
)


def random_states(count: int, seed: int = 0) -> Tensor:
    """Any attitude, also upside down; w >= 0."""
    random = np.random.default_rng(seed)
    states = random.normal(size=(count, 13))
    quaternion = states[:, QUATERNION] / np.linalg.norm(states[:, QUATERNION], axis=1)[:, None]
    states[:, QUATERNION] = np.where(quaternion[:, :1] < 0, -quaternion, quaternion)
    return torch.from_numpy(states.astype(np.float32))


def turned(states: Tensor, by: np.ndarray) -> Tensor:
    """The same flight with the world turned by a quaternion; bodies stay as they are."""
    out = states.numpy().astype(np.float64)
    out[:, QUATERNION] = rotation.multiply(by, out[:, QUATERNION])
    out[:, VELOCITY] = rotation.rotate(np.broadcast_to(by, (len(out), 4)), out[:, VELOCITY])
    return torch.from_numpy(out.astype(np.float32))


def test_a_motion_leads_back_to_the_state() -> None:
    now, then = random_states(500), random_states(500, seed=1)
    again = state_after(now, motion_since(now, then))
    torch.testing.assert_close(again, then, atol=2e-5, rtol=0)


def test_features_do_not_depend_on_the_heading() -> None:
    by = about_z(np.array([1.1]))[0]
    past, then = random_states(2), random_states(7, seed=1)
    past_turned, then_turned = turned(past, by), turned(then, by)
    torch.testing.assert_close(
        context_features(past_turned[None], Contract()),
        context_features(past[None], Contract()),
        atol=1e-5,
        rtol=0,
    )
    motion = motion_since(past[1], then)
    torch.testing.assert_close(motion_since(past_turned[1], then_turned), motion, atol=1e-5, rtol=0)
