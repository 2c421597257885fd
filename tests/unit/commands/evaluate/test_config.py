"""Evaluations that would fly what was trained on are refused."""

import pytest

from mavbridge.commands.evaluate.run import EpisodeSpec
from mavbridge.config.episodes import (
    MAX_EPISODES,
    MAX_EVALUATION_SEED,
    RACE_COURSE_SEED,
    EvaluateConfig,
)
from mavbridge.config.policy import PolicyConfig
from mavbridge.core.errors import UserError


def test_no_seed_reaches_the_courses_of_another_family() -> None:
    last = EvaluateConfig(policy=PolicyConfig(seed=MAX_EVALUATION_SEED), episodes=MAX_EPISODES)
    assert EpisodeSpec(config=last, index=MAX_EPISODES - 1).course_seed < RACE_COURSE_SEED
    with pytest.raises(UserError, match="--seed must be between 0 and"):
        EvaluateConfig(policy=PolicyConfig(seed=MAX_EVALUATION_SEED + 1))
