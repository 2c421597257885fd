"""Commands that fly in simulated time close what they have loaded, however the flight ends."""

from pathlib import Path

import pytest

from helpers.noted_policy import noted_calls, noted_policy
from mavbridge.commands.evaluate import EpisodeSpec, fly_simulated
from mavbridge.config.episodes import EvaluateConfig
from mavbridge.config.policy import PolicyConfig
from mavbridge.simulation.referee import EpisodeInterruptedError


def life(folder: Path) -> list[str]:
    names = [name for name, _ in noted_calls(folder)]
    return [name for name in names if name in ("__init__", "reset", "close")]


def test_each_episode_of_an_evaluation_has_a_policy_with_a_whole_life(tmp_path: Path) -> None:
    config = EvaluateConfig(policy=PolicyConfig(policy=noted_policy(tmp_path)), max_time=1.0)
    for index in range(2):
        fly_simulated(EpisodeSpec(config=config, index=index), lambda: False)
        assert life(tmp_path) == ["__init__", "reset", "reset", "close"]


def test_an_interrupted_episode_closes_its_policy(tmp_path: Path) -> None:
    config = EvaluateConfig(policy=PolicyConfig(policy=noted_policy(tmp_path)))
    with pytest.raises(EpisodeInterruptedError):
        fly_simulated(EpisodeSpec(config=config, index=0), lambda: True)
    assert life(tmp_path) == ["__init__", "reset", "close"]
