"""Evaluation in real processes: workers, and a flight on the wall clock."""

from pathlib import Path

import pytest

from mavbridge.commands.evaluate.config import EvaluateConfig
from mavbridge.commands.evaluate.episodes import EpisodeSpec, fly_on_wall_clock
from mavbridge.commands.evaluate.run import evaluate
from mavbridge.config.policy import PolicyConfig
from mavbridge.config.workers import WorkersConfig

pytestmark = pytest.mark.system

CIRCLE = PolicyConfig(policy="scripted:circle", dual_rate=True)


def test_two_workers_write_what_one_writes(tmp_path: Path) -> None:
    for workers in (1, 2):
        config = EvaluateConfig(
            policy=CIRCLE,
            episodes=3,
            max_time=1.0,
            conditions="random",
            workers=WorkersConfig(workers=workers),
            json=tmp_path / f"{workers}.json",
        )
        assert evaluate(config) == 0
    assert (tmp_path / "1.json").read_bytes() == (tmp_path / "2.json").read_bytes()


def test_an_episode_flies_on_the_wall_clock() -> None:
    config = EvaluateConfig(
        policy=CIRCLE, episodes=1, max_time=2.0, clock="wall", conditions="random"
    )
    flown = fly_on_wall_clock(EpisodeSpec(config=config, index=0), lambda: False)
    assert flown.engine == "numpy"
    assert flown.result.outcome == "timed out"
    assert flown.result.flown_s >= 2.0
    assert flown.result.distance_m > 0.2
