"""How a policy flies where no flag says it: at two rates, and toge in one step from noise."""

from typing import Any

import pytest

from mavbridge.__main__ import main
from mavbridge.config.policy import PolicyConfig
from mavbridge.core.errors import UserError


@pytest.mark.parametrize(
    ("changes", "is_dual", "steps", "warm_steps"),
    [
        ({}, True, 1, None),
        ({"policy": "toge:medium"}, True, 1, None),
        ({"dual_rate": False}, False, 1, None),
        ({"head_steps": 0}, True, 1, None),
        ({"head_steps": 3}, True, 10, 3),
        ({"num_diffusion_steps": 4, "head_steps": 2}, True, 4, 2),
        ({"policy": "resnet-unet"}, False, 10, None),
        ({"policy": "toge-rates"}, True, 1, None),
        ({"policy": "toge-rates", "num_diffusion_steps": 4}, True, 4, None),
        ({"policy": "./mine.py:Mine"}, True, 10, None),
        ({"policy": "./mine.py:Mine", "head_steps": 2}, True, 10, 2),
    ],
)
def test_defaults(
    changes: dict[str, Any], is_dual: bool, steps: int, warm_steps: int | None
) -> None:
    config = PolicyConfig(**changes)
    assert (config.may_be_dual, config.steps, config.warm_steps) == (is_dual, steps, warm_steps)


def test_a_warm_start_has_no_more_steps_than_a_solve() -> None:
    with pytest.raises(UserError, match="--head-steps must be between 0 and 4"):
        PolicyConfig(num_diffusion_steps=4, head_steps=5)


@pytest.mark.parametrize("flag", ["--dual-rate", "--no-dual-rate", "--single-rate"])
def test_every_spelling_of_the_rates_is_taken(
    flag: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main(["--connect", "nowhere", flag])
    assert "--connect 'nowhere' is not understood" in capsys.readouterr().err
