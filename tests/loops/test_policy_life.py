"""Commands that fly in simulated time close what they have loaded, however the flight ends."""

from pathlib import Path

import pytest

from mavbridge.commands.evaluate import EpisodeSpec, fly_simulated
from mavbridge.config.episodes import EvaluateConfig
from mavbridge.config.policy import PolicyConfig
from mavbridge.simulation.referee import EpisodeInterruptedError

POLICY = """
from pathlib import Path

import numpy as np
from policy.contract import Contract

CALLS = Path(__file__).with_suffix(".calls")


class Resting:
    contract = Contract(arrays="numpy", image_height=32, image_width=32)

    def __init__(self):
        self.note("made")

    def predict(self, image, state, action_history, num_diffusion_steps):
        return np.zeros((1, 16, 4), np.float32)

    def reset(self):
        self.note("reset")

    def close(self):
        self.note("close")

    def note(self, text):
        with CALLS.open("a") as file:
            file.write(text + "\\n")
"""


@pytest.fixture
def resting(tmp_path: Path) -> PolicyConfig:
    (tmp_path / "resting.py").write_text(POLICY)
    return PolicyConfig(policy=f"{tmp_path}/resting.py:Resting")


def calls(policy: PolicyConfig) -> list[str]:
    file = Path(policy.policy.partition(":")[0]).with_suffix(".calls")
    lines = file.read_text().split()
    file.unlink()
    return lines


def test_each_episode_of_an_evaluation_has_a_policy_with_a_whole_life(
    resting: PolicyConfig,
) -> None:
    config = EvaluateConfig(policy=resting, max_time=1.0)
    for index in range(2):
        fly_simulated(EpisodeSpec(config=config, index=index), lambda: False)
        assert calls(resting) == ["made", "reset", "reset", "close"]


def test_an_interrupted_episode_closes_its_policy(resting: PolicyConfig) -> None:
    config = EvaluateConfig(policy=resting)
    with pytest.raises(EpisodeInterruptedError):
        fly_simulated(EpisodeSpec(config=config, index=0), lambda: True)
    assert calls(resting) == ["made", "reset", "close"]
