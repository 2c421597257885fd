import os
from pathlib import Path

import numpy as np
import pytest

from benchmarks import flight
from benchmarks.flight import (
    CLIMB_STICK,
    SLOW_EVERY,
    SLOW_NS,
    Counters,
    FlightMeter,
    level_climb,
    read_counters,
    with_slow_solves,
)
from helpers.factories import make_released_tick, make_state, make_tick, make_vision_tick
from mavbridge.core.clock import NS_PER_MS, MonotonicClock
from mavbridge.core.reasons import Code, because
from policy.contract import Contract
from policy.protocol import PolicyRunner


def test_a_level_climb_does_the_work_and_returns_other_sticks() -> None:
    called: list[int] = []

    def act(*arguments: object) -> np.ndarray:
        called.append(len(arguments))
        return np.ones((1, 16, 4), np.float32)

    runner = PolicyRunner(
        contract=Contract(), name="a", engine="b", dual_rate=True, encode=lambda rgb: rgb, act=act
    )
    history = np.zeros((1, 4, 4), np.float32)
    climb = level_climb(runner)
    assert climb.contract.max_state_age_s == climb.contract.max_chunk_age_s == 5.0
    chunk = climb.act(history, make_state().values[None], history)
    assert called == [3]
    assert (chunk == np.float32([CLIMB_STICK, 0, 0, 0])).all()


def test_a_flight_is_measured_from_its_first_action_on() -> None:
    meter = FlightMeter(os.getpid(), stick_hz=100, action_hz=100, vision_hz=30)
    for index in range(50):
        meter.emit(make_released_tick(index))
        meter.emit(make_vision_tick(index))
    for index in range(100, 112):
        meter.emit(make_tick(index, missed_slots=50 if index == 100 else 0))
    report = meter.report()
    assert report.sticks.sends == 12
    assert report.sticks.missed_slots == 0
    assert report.action.rate_hz == pytest.approx(100)
    assert report.vision.frames == 0
    for index in range(112, 115):
        meter.emit(make_tick(index, missed_slots=2 if index == 113 else 0))
        meter.emit(make_vision_tick(index))
    report = meter.report()
    assert (report.sticks.missed_slots, report.vision.frames) == (2, 3)
    assert meter.spent.ours > 0
    assert meter.release_reason is None
    for index, code in enumerate((Code.NO_CHUNK, Code.DISARMED)):
        meter.emit(make_released_tick(200 + index, because(code)))
    assert meter.release_reason == because(Code.NO_CHUNK)


def test_every_tenth_solve_is_slow_and_all_are_the_policys() -> None:
    runner = PolicyRunner(
        contract=Contract(),
        name="a",
        engine="b",
        dual_rate=True,
        encode=lambda rgb: rgb,
        act=lambda *arguments: arguments[0],
    )
    slow, clock, durations_ns = with_slow_solves(runner), MonotonicClock(), []
    for number in range(2 * SLOW_EVERY):
        start_ns = clock.now_ns()
        assert slow.act(number, None, None) == number
        durations_ns.append(clock.now_ns() - start_ns)
    assert min(durations_ns[SLOW_EVERY - 1 :: SLOW_EVERY]) >= SLOW_NS


def test_counters_are_the_kernels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flight, "PROC", tmp_path)
    monkeypatch.setattr(flight.os, "sysconf", lambda _: 100)
    assert read_counters(7)[1:] == (0, 0, 0)
    (tmp_path / "7").mkdir()
    (tmp_path / "7" / "schedstat").write_text("5000000 3000000 12\n")
    (tmp_path / "stat").write_text(
        "cpu  100 0 50 9000 3 0 7 4 0 0\ncpu0 50 0 25 4500 1 0 3 1 0 0\n"
    )
    expected = Counters(ours=0, guard=5 * NS_PER_MS, waited=3 * NS_PER_MS, host=40 * NS_PER_MS)
    assert read_counters(7)[1:] == expected[1:]
