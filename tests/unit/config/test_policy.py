"""How a policy flies where no flag says it: at two rates, and toge in one step from noise."""

from typing import Any

import pytest

from mavbridge.config.policy import PolicyConfig


@pytest.mark.parametrize(
    ("changes", "is_dual", "steps"),
    [
        ({}, True, 1),
        ({"policy": "toge:medium"}, True, 1),
        ({"dual_rate": False}, False, 1),
        ({"policy": "resnet-unet"}, False, 10),
        ({"policy": "toge-rates"}, True, 1),
        ({"policy": "toge-rates", "num_diffusion_steps": 4}, True, 4),
        ({"policy": "./mine.py:Mine"}, True, 10),
    ],
)
def test_defaults(changes: dict[str, Any], is_dual: bool, steps: int) -> None:
    config = PolicyConfig(**changes)
    assert (config.may_be_dual, config.steps) == (is_dual, steps)
