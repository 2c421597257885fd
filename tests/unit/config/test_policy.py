"""How a policy flies where no flag says it: at two rates, and toge with a warm start."""

from typing import Any

import pytest

from mavbridge.__main__ import main
from mavbridge.config.policy import PolicyConfig
from mavbridge.core.errors import UserError


@pytest.mark.parametrize(
    ("changes", "is_dual", "warm_steps"),
    [
        ({}, True, 2),
        ({"policy": "toge:medium"}, True, 2),
        ({"dual_rate": True}, True, 2),
        ({"dual_rate": False}, False, None),
        ({"head_steps": 0}, True, None),
        ({"head_steps": 3}, True, 3),
        ({"num_diffusion_steps": 2}, True, None),  # a warm start of all steps saves nothing
        ({"policy": "resnet-unet"}, False, None),
        ({"policy": "toge-rates"}, True, None),
        ({"policy": "./mine.py:Mine"}, True, None),
        ({"policy": "./mine.py:Mine", "head_steps": 2}, True, 2),
    ],
)
def test_defaults(changes: dict[str, Any], is_dual: bool, warm_steps: int | None) -> None:
    config = PolicyConfig(**changes)
    assert (config.may_be_dual, config.warm_steps) == (is_dual, warm_steps)


def test_steps_from_noise_are_those_that_the_weights_fly_best_with() -> None:
    assert PolicyConfig().steps == 10
    assert PolicyConfig(policy="toge-rates").steps == 1
    assert PolicyConfig(policy="toge-rates", num_diffusion_steps=4).steps == 4


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
