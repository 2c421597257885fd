"""Which engine flies a policy, and what is said of the others."""

import logging
import re
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from helpers import torch_policies
from helpers.torch_policies import (
    Counter,
    CountingBy,
    Scripted,
    Slotted,
    TwoRates,
    changed,
    counter_in,
    scripted,
)
from policy.contract import FloatArray
from policy.engines import openvino_modules
from policy.engines.choose import MAX_STICK_ERROR, Candidate, choose_runner, first_that_agrees
from policy.engines.runner import ExecutionSettings, dummy_sample, encode_all
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


NEVER, SOURCE, NEWS = datetime.max.replace(tzinfo=UTC), Path(__file__), SimpleQueue[float]()
DECIDING = [
    (TwoRates, lambda chunk, state: chunk if state[0, 2] < 100 else -chunk),
    (TwoRates, lambda chunk, state: chunk * min(state[0, 2], torch.tensor(100.0))),
    (TwoRates, lambda chunk, state: chunk * torch.tensor(100 - state[0, 2].item()).clamp(0, 1)),
    (TwoRates, read_where_written),
    (Scripted, lambda chunk, state: chunk if state[0, 2] < 100 else -chunk),
    (Scripted, lambda chunk, state: -chunk if len(state[state[:, 2] > 100]) else chunk),
    (Scripted, lambda chunk, state: -chunk if len(torch.where(state > 100)[0]) else chunk),
]
NO_GRAPHS = [
    *((partial(changed, *each), "it decides by the values of a tensor") for each in DECIDING),
    (torch_policies.Counting, "it keeps calls from call to call"),
    (torch_policies.CountingInClass, "it keeps calls from call to call"),
    (partial(CountingBy, torch_policies.tick), "it keeps clock from call to call"),
    (torch_policies.Resetting, "the policy has reset"),
    *(
        (partial(changed, TwoRates, change), reason)
        for change, reason in (
            (
                lambda chunk, _: chunk if datetime.now(UTC) < NEVER else -chunk,
                "it calls now, which",
            ),
            (lambda chunk, _: chunk if SOURCE.read_text() else -chunk, "it calls .*open.*read"),
            (lambda chunk, _: chunk if NEWS.empty() else -chunk, "it calls empty, which a graph"),
            (
                lambda chunk, _: chunk + 0.1 * torch.randn_like(chunk),
                "warning: engine torch: the same inputs do not give the same chunk again",
            ),
            (lambda chunk, _: sum([1e-9] * 100, chunk), "its graph has 1.. operations, and at mo"),
        )
    ),
]


@pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")
@pytest.mark.parametrize(("make", "reason"), NO_GRAPHS)
def test_modules_that_no_graph_computes_run_in_torch_with_a_reason(make, reason, monkeypatch):
    monkeypatch.setattr(openvino_modules, "MAX_OPERATIONS", 90)
    policy, level = make(), logging.root.level
    runner, notes = choose_runner(policy, "auto", SETTINGS)
    assert runner.engine == "torch"
    assert logging.root.level == level  # the converter raises it
    assert notes
    assert all(re.search(reason, note) for note in notes)


@pytest.mark.parametrize(
    "count",
    [
        torch_policies.count_in_global,
        torch_policies.count_in_default,
        torch_policies.count_in_cached,
        *map(
            counter_in, (torch_policies.MODULE, scripted, [SimpleNamespace()], deque([Slotted()]))
        ),
        Counter().count,
        partial(Counter.count, Counter()),
    ],
)
def test_a_memory_behind_functions_is_found(count: Callable[[], object]) -> None:
    runner, notes = choose_runner(CountingBy(count), "auto", SETTINGS)
    assert runner.engine == "torch"
    assert notes == ("engine torch: it keeps calls from call to call, which a graph cannot",)


def test_what_a_thread_of_the_policy_tells_it_is_flown() -> None:
    settings = replace(SETTINGS, threads=frozenset(threading.enumerate()))
    assert choose_runner(TwoRates(), "auto", settings)[0].engine.startswith("openvino")
    policy = torch_policies.Listening()
    runner, notes = choose_runner(policy, "auto", settings)
    assert notes == ("engine torch: it runs threads, whose news a graph would not see",)
    policy.told.set()
    policy.thread.join()
    images, state, history = dummy_sample(runner.contract)
    assert (runner.act(encode_all(runner, images), state, history) == 0.5).all()


def test_what_python_keeps_in_a_module_is_no_memory() -> None:
    policy = CountingBy(torch_policies.warn_in_module)
    assert choose_runner(policy, "auto", SETTINGS)[0].engine.startswith("openvino")


def test_a_second_start_converts_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    converted, convert = [], openvino_modules._converted

    def counted(module: nn.Module, examples: tuple[torch.Tensor, ...]) -> Any:
        converted.append(module)
        return convert(module, examples)

    monkeypatch.setattr(openvino_modules, "_converted", counted)
    for _ in range(2):
        choose_runner(TwoRates(), "auto", SETTINGS)
        assert len(converted) == 2
    changed = TwoRates()
    with torch.no_grad():
        changed.head.layers[0].bias[0] += 1  # type: ignore[union-attr, operator]
    assert choose_runner(changed, "auto", SETTINGS)[0].engine.startswith("openvino")
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
    chunk[0, 7, 2] += 2 * MAX_STICK_ERROR
    return chunk


@pytest.mark.parametrize(
    ("alter", "reason"),
    [
        (one_bad_stick, r"a stick is off by 0\.02"),
        (np.zeros_like, r"the cosine is 0\.0"),
        (lambda chunk: np.full_like(chunk, np.nan), "NaN or infinity"),
        (lambda chunk: chunk[:, :8], r"chunks of shape \[4, 8, 4\]"),
    ],
)
def test_a_wrong_engine_is_passed_over_with_its_reason(small_toge, alter, reason):
    runner, notes = first_that_agrees(small_toge, [altered(small_toge, alter)], SETTINGS)
    assert runner.engine == "torch"
    assert len(notes) == 1
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
