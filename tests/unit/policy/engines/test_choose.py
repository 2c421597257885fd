"""The parity check: which engine flies, and what is said of the others."""

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from policy.contract import FloatArray
from policy.engines.choose import MAX_STICK_ERROR, Candidate, choose_runner, first_that_agrees
from policy.engines.runner import ExecutionSettings
from policy.engines.torch_eager import make_torch_runner
from policy.errors import PolicyError
from policy.nets.toge import Toge
from policy.protocol import PolicyRunner

SETTINGS = ExecutionSettings(name="toge", num_diffusion_steps=2)


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


def test_an_engine_that_fails_is_passed_over(small_toge: Toge) -> None:
    def broken() -> PolicyRunner:
        raise RuntimeError("no memory\nat x.cpp:3")

    right = altered(small_toge, lambda chunk: chunk)
    runner, notes = first_that_agrees(small_toge, [("broken", broken), right], SETTINGS)
    assert runner.engine == "wrong"  # by name only
    assert "engine broken is passed over" in notes[0]
    assert notes[0].endswith("no memory")
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
    settings = replace(SETTINGS, vision_device=device, action_device=device)
    with pytest.raises(PolicyError, match=message):
        choose_runner(small_toge, engine, settings)
