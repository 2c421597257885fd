"""Evaluation in several processes."""

from pathlib import Path

import pytest

from mavbridge.commands.evaluate import evaluate
from mavbridge.config.episodes import EvaluateConfig, WorkersConfig
from mavbridge.config.policy import PolicyConfig

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
