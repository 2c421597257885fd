"""The check of a training run flies, on courses of its own."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from helpers.evaluated_flights import crashed
from mavbridge.commands import train as train_check
from mavbridge.config.episodes import (
    CHECK_COURSE_SEED,
    COURSE_SEEDS,
    HELD_OUT_COURSE_SEED,
    MAX_EPISODES,
)
from mavbridge.config.policy import PolicyConfig
from mavbridge.core.clock import Clock
from mavbridge.flight.policies import load_configured_policy
from mavbridge.simulation.referee import EpisodeResult
from policy.checkpoints.networks import save_checkpoint
from policy.contract import Contract, FloatArray
from policy.loading.request import LoadedPolicy
from policy.nets.toge import Toge, TogeConfig
from policy.protocol import PolicyRunner
from policy.training.settings import TrainSettings


def save(path: Path, seed: int) -> Path:
    torch.manual_seed(seed)
    contract = Contract(image_height=32, image_width=32)
    save_checkpoint(path, Toge(TogeConfig(backbone="resnet8", contract=contract)).eval())
    return path


def load_for_torch(config: PolicyConfig, clock: Clock) -> LoadedPolicy:
    return load_configured_policy(replace(config, engine="torch"), clock)


@pytest.fixture
def flown(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, FloatArray]]:
    """Course and feature of each flight; one with the seed n passes 2 n gates."""
    flights: list[tuple[int, FloatArray]] = []

    def fly(runner: PolicyRunner, *, course_seed: int, seed: int) -> EpisodeResult:
        assert runner.dual_rate
        flights.append((course_seed, runner.encode(np.full((32, 32, 3), 128, np.uint8))))
        return crashed(
            course_seed=course_seed, seed=seed, gates_total=8, gate_times_s=(1.0,) * (2 * seed)
        )

    monkeypatch.setattr(
        "mavbridge.simulation.flight.SimulatedFlight",
        lambda **seeds: SimpleNamespace(fly=partial(fly, **seeds)),
    )
    monkeypatch.setattr(train_check, "load_configured_policy", load_for_torch)  # compiles nothing
    return flights


def test_counts_the_gates_of_courses_that_nothing_else_flies_with_the_weights_in_the_file(
    tmp_path: Path, flown: list[tuple[int, FloatArray]]
) -> None:
    path = tmp_path / "toge.safetensors"
    settings = TrainSettings(out=path, check_flights=3)
    share = train_check.share_of_gates(save(path, 0), settings)
    assert share == pytest.approx((0 + 2 + 4) / 24)
    assert [course for course, _ in flown] == [CHECK_COURSE_SEED + index for index in range(3)]
    assert CHECK_COURSE_SEED + MAX_EPISODES <= HELD_OUT_COURSE_SEED
    races = replace(settings, check_flights=1, check_courses="race")
    train_check.share_of_gates(save(path, 1), races)
    assert flown[-1][0] == COURSE_SEEDS["race"] + CHECK_COURSE_SEED
    assert not np.allclose(flown[0][1], flown[-1][1])
