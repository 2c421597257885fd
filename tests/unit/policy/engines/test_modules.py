"""Torch modules of a user: which of them are converted, and why others are not."""

import logging
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from helpers import torch_policies
from helpers.torch_policies import PlainClass, Stepwise, TwoRates
from policy.engines import openvino_modules
from policy.engines.choose import (
    choose_runner,
    chunks_of_samples,
    make_parity_samples,
    parity_failure,
)
from policy.engines.runner import ExecutionSettings
from policy.engines.torch_eager import make_torch_runner
from policy.protocol import SingleRatePolicy

SETTINGS = ExecutionSettings(name="mine", num_diffusion_steps=4)

pytestmark = pytest.mark.usefixtures("own_cache")


@pytest.fixture
def own_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


def require_parity(policy: SingleRatePolicy, settings: ExecutionSettings) -> None:
    runner, notes = choose_runner(policy, "auto", settings)
    assert runner.engine.startswith("openvino"), notes
    samples = make_parity_samples(policy.contract)
    expected = chunks_of_samples(make_torch_runner(policy, settings), samples)
    assert parity_failure(expected, chunks_of_samples(runner, samples)) is None


@pytest.mark.parametrize(
    ("make", "dual_rate"),
    [(TwoRates, True), (PlainClass, False), (Stepwise, True), (Stepwise, False)],
)
def test_modules_fly_converted(make: type[SingleRatePolicy], dual_rate: bool) -> None:
    require_parity(make(), replace(SETTINGS, dual_rate=dual_rate))


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("Counting", "it keeps calls from call to call"),
        ("Drawing", "the same inputs do not give the same chunk again"),
        ("Resetting", "the policy has reset"),
        ("Deciding", "it decides by the values of a tensor"),
        ("Looping", "its graph has 1.. operations, and at most 90"),
    ],
)
def test_modules_that_no_graph_computes_run_in_torch_with_a_reason(name, reason, monkeypatch):
    monkeypatch.setattr(openvino_modules, "MAX_OPERATIONS", 90)
    policy, level = getattr(torch_policies, name)(), logging.root.level
    runner, notes = choose_runner(policy, "auto", SETTINGS)
    assert runner.engine == "torch"
    assert logging.root.level == level  # the converter raises it
    assert notes
    assert all(re.search(reason, note) for note in notes)


def test_a_second_start_converts_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    converted, convert = [], openvino_modules._converted

    def counted(module: nn.Module, examples: tuple[torch.Tensor, ...]) -> Any:
        converted.append(module)
        return convert(module, examples)

    monkeypatch.setattr(openvino_modules, "_converted", counted)
    for _ in range(2):
        require_parity(TwoRates(), SETTINGS)
        assert len(converted) == 2
    changed = TwoRates()
    with torch.no_grad():
        changed.head.layers[0].bias[0] += 1  # type: ignore[union-attr, operator]
    require_parity(changed, SETTINGS)
    assert len(converted) == 3  # the encoder is the same


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_new_weights_of_a_frozen_archive_are_compiled(tmp_path: Path) -> None:
    def compiled(weight: float) -> float:
        layer = nn.Linear(64, 64, bias=False).eval()
        nn.init.constant_(layer.weight, weight)
        torch.jit.freeze(torch.jit.script(layer)).save(tmp_path / "frozen.pt")
        frozen = torch.jit.load(tmp_path / "frozen.pt")
        converter = openvino_modules.ModuleConverter(frozen, "frozen")
        call = converter.compile(lambda x: frozen(x), [(1, 64)], "f32")
        return float(call(np.ones((1, 64), np.float32))[0, 0])

    assert [compiled(1.0), compiled(2.0)] == [64.0, 128.0]
