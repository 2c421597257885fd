"""Which engine flies a policy, and what is said of the others."""

import logging
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from helpers import torch_policies
from helpers.torch_policies import TwoRates, changed
from policy.contract import FloatArray
from policy.engines import openvino_modules
from policy.engines.choose import (
    MAX_ACTION_ERROR,
    Candidate,
    choose_runner,
    first_that_agrees,
    parity_failure,
)
from policy.engines.runner import EngineName, ExecutionSettings
from policy.engines.torch_engines import make_torch_runner
from policy.errors import PolicyError
from policy.nets.toge import Toge
from policy.protocol import PolicyRunner

SETTINGS = ExecutionSettings(name="mine", num_diffusion_steps=4)

pytestmark = pytest.mark.usefixtures("own_cache")


@pytest.fixture
def own_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


def read_where_written(chunk: Tensor, state: Tensor) -> Tensor:
    height = torch.zeros(2)
    height.split(1)[0][0] = state[0, 2]
    return chunk * (100 - height[0].item())


NO_GRAPHS = [
    (lambda chunk, state: chunk if state[0, 2] < 100 else -chunk, "it decides by the values"),
    (
        lambda chunk, state: chunk * torch.tensor(100 - state[0, 2].item()).clamp(0, 1),
        "it decides by the values of a tensor",
    ),
    (read_where_written, "it decides by the values of a tensor"),
    (
        lambda chunk, _: chunk + 0.1 * torch.randn_like(chunk),
        "warning: engine torch: the same inputs do not give the same chunk again",
    ),
    (lambda chunk, _: sum([1e-9] * 100, chunk), "its graph has 1.. operations, and at mo"),
]


@pytest.mark.parametrize(("change", "reason"), NO_GRAPHS)
def test_modules_that_no_graph_computes_run_in_torch_with_a_reason(change, reason, monkeypatch):
    monkeypatch.setattr(openvino_modules, "MAX_OPERATIONS", 90)
    policy, level = changed(change), logging.root.level
    runner, notes = choose_runner(policy, "openvino", SETTINGS)
    assert runner.engine == "torch"
    assert logging.root.level == level  # the converter raises it
    assert notes
    assert all(re.search(reason, note) for note in notes if note != "engine torch")


@pytest.mark.parametrize("engine", ["auto", "openvino"])
def test_a_policy_with_reset_runs_in_torch(engine: EngineName) -> None:
    runner, (note,) = choose_runner(torch_policies.Resetting(), engine, SETTINGS)
    assert runner.engine == "torch"
    assert "the policy has reset" in note


def test_a_second_start_converts_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    converted, convert = [], openvino_modules._converted

    def counted(module: nn.Module, examples: tuple[torch.Tensor, ...]) -> Any:
        converted.append(module)
        return convert(module, examples)

    monkeypatch.setattr(openvino_modules, "_converted", counted)
    for _ in range(2):
        choose_runner(TwoRates(), "auto", SETTINGS)
        assert len(converted) == 2
    other = TwoRates()
    with torch.no_grad():
        other.head.layers[0].bias[0] += 1  # type: ignore[union-attr, operator]
    assert choose_runner(other, "auto", SETTINGS)[0].engine.startswith("openvino")
    assert len(converted) == 3  # the encoder is the same


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_new_weights_of_a_frozen_archive_are_compiled(tmp_path: Path) -> None:
    def compiled(weight: float) -> float:
        layer = nn.Linear(64, 64, bias=False).eval()
        nn.init.constant_(layer.weight, weight)
        torch.jit.freeze(torch.jit.script(layer)).save(tmp_path / "frozen.pt")
        frozen = torch.jit.load(tmp_path / "frozen.pt")
        converter = openvino_modules.ModuleConverter(frozen, SETTINGS)
        call = converter.compile(lambda x: frozen(x), [(1, 64)], "f32")
        return float(call(np.ones((1, 64), np.float32))[0, 0])

    assert [compiled(1.0), compiled(2.0)] == [64.0, 128.0]


# --- The parity check


def altered(policy: Toge, alter: Callable[[FloatArray], FloatArray]) -> Candidate:
    """An engine that gets the chunks wrong."""

    def make() -> PolicyRunner:
        right = make_torch_runner(policy, SETTINGS)

        def act(*arrays: Any) -> FloatArray:
            return alter(right.act(*arrays))

        return replace(right, engine="wrong", act=act)

    return ("wrong", make)


def one_bad_stick(chunk: FloatArray) -> FloatArray:
    chunk = chunk.copy()
    chunk[0, 7, 2] += 2 * MAX_ACTION_ERROR
    return chunk


def test_actions_in_metres_a_second_are_compared_by_their_size() -> None:
    velocities = np.random.default_rng(0).uniform(-8.0, 8.0, (4, 16, 4)).astype(np.float32)
    assert parity_failure(velocities, velocities + 0.05) is None
    assert parity_failure(velocities / 8, velocities / 8 + 0.05) is not None


@pytest.mark.parametrize(
    ("alter", "reason"),
    [
        (one_bad_stick, r"an action is off by 0\.02"),
        (np.zeros_like, r"the cosine is 0\.0"),
        (lambda chunk: np.full_like(chunk, np.nan), "NaN or infinity"),
        (lambda chunk: chunk[:, :8], r"chunks of shape \[4, 8, 4\]"),
    ],
)
def test_a_wrong_engine_is_passed_over_with_its_reason(small_toge, alter, reason):
    runner, notes = first_that_agrees(small_toge, [altered(small_toge, alter)], SETTINGS)
    assert runner.engine == "torch"
    assert notes[1:] == ("engine torch",)
    assert notes[0].startswith("warning: engine wrong is passed over: ")
    assert re.search(reason, notes[0])


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (RuntimeError("no memory\nat x.cpp:3"), "RuntimeError: no memory"),
        (TypeError(), "TypeError: (nothing)"),
    ],
)
def test_an_engine_that_fails_is_passed_over(small_toge: Toge, error: Exception, told: str) -> None:
    def broken() -> PolicyRunner:
        raise error

    right = altered(small_toge, lambda chunk: chunk)
    runner, notes = first_that_agrees(small_toge, [("broken", broken), right], SETTINGS)
    assert runner.engine == "wrong"  # by name only
    assert "engine broken is passed over" in notes[0]
    assert notes[0].endswith(told)
    assert "agrees with torch" in notes[1]


def test_without_openvino_torch_flies(small_toge: Toge, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("policy.engines.choose.find_spec", lambda name: None)
    assert choose_runner(small_toge, "auto", SETTINGS)[0].engine == "torch"
    with pytest.raises(PolicyError, match="pip install openvino"):
        choose_runner(small_toge, "openvino", SETTINGS)


@pytest.mark.parametrize(
    ("engine", "device", "message"),
    [
        ("cuda-graph", "cpu", "runs on --device cuda, not on"),
        ("openvino", "cuda:1", "runs on --device cpu, not on"),
    ],
)
def test_an_engine_asked_for_on_the_wrong_device_is_refused(small_toge, engine, device, message):
    settings = replace(SETTINGS, device=device)
    with pytest.raises(PolicyError, match=message):
        choose_runner(small_toge, engine, settings)
