"""The figures of a soak, the description of a computer, and the row of both."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.factories import (
    make_plan,
    make_released_tick,
    make_state,
    make_tick,
    make_vision_tick,
)
from helpers.fakes import FakeClock
from mavbridge.commands.check import computer
from mavbridge.commands.check.computer import hottest_c, read_usage, this_computer
from mavbridge.commands.check.soak import (
    CLIMB_STICK,
    USAGE_NS,
    FlightMeter,
    climb_config,
    level_climb,
)
from mavbridge.config.flight import FlyConfig
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.errors import PeerError
from mavbridge.core.reasons import Code, because
from policy.contract import Contract
from policy.protocol import PolicyRunner

RATES = Contract(action="rates", cameras=("left", "right"), feature_dim=2)


def make_runner(calls: list[int]) -> PolicyRunner:
    def act(*arguments: object) -> np.ndarray:
        calls.append(len(arguments))
        return np.ones((1, 16, 4), np.float32)

    names = {"name": "mine", "engine": "numpy"}
    return PolicyRunner(**names, contract=RATES, dual_rate=True, encode=lambda rgb: rgb, act=act)


def make_meter(clock: FakeClock) -> FlightMeter:
    return FlightMeter(make_plan(), make_runner([]), clock=clock, guard_pid=os.getpid())


def test_a_level_climb_does_the_work_and_returns_other_sticks() -> None:
    called: list[int] = []
    climb = level_climb(make_runner(called))
    assert (climb.contract.action, climb.contract.modes) == ("sticks", ("ALT_HOLD",))
    assert climb.contract.max_state_age_s == climb.contract.max_chunk_age_s == 5.0
    history = np.zeros((1, 4, 4), np.float32)
    chunk = climb.act(history, make_state().values[None], history)
    assert called == [3]
    assert (chunk == np.float32([CLIMB_STICK, 0, 0, 0])).all()


def test_every_camera_of_a_policy_gets_the_vehicles_images() -> None:
    config = climb_config(FlyConfig(), RATES, port=5, source="shm:a")
    assert config.camera.sources_of(RATES.cameras) == ("shm:a", "shm:a")
    assert (config.link.connect, config.arm) == ("udp:127.0.0.1:5", True)


def test_images_are_judged_by_the_rate_of_the_first_camera() -> None:
    plan = make_plan(replace(RATES, camera_rates_hz=(10.0, 60.0)))
    assert plan.image_rates_hz == (10.0, 30.0)
    meter = FlightMeter(plan, make_runner([]), clock=FakeClock(), guard_pid=os.getpid())
    assert meter.report().vision.target_hz == 10.0


def test_a_flight_is_measured_from_its_first_action_on() -> None:
    meter = make_meter(FakeClock())
    for index in range(50):
        meter.emit(make_released_tick(index))
        meter.emit(make_vision_tick(index))
    with pytest.raises(PeerError, match="never had the sticks"):
        meter.figures()
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
    assert meter.release_reason is None
    for index, code in enumerate((Code.NO_CHUNK, Code.DISARMED)):
        meter.emit(make_released_tick(200 + index, because(code)))
    assert meter.release_reason == because(Code.NO_CHUNK)


def test_figures_are_those_between_two_readings_a_second_apart() -> None:
    clock = FakeClock()
    meter = make_meter(clock)
    meter.emit(make_tick(0))
    sum(range(200_000))  # some processor time
    clock.advance_ns(USAGE_NS)
    meter.emit(make_tick(100, missed_slots=3))
    soak = meter.figures()
    assert 0 < soak.cpu_cores["flight"] < 1
    assert "flight/MainThread" in soak.cpu_cores
    computer = replace(soak.computer, cores=2)
    row = replace(soak, computer=computer, hottest_c=71.4).row()
    assert row.verdict == "warn"
    assert "missed slots" in row.warn
    assert "rate" not in row.warn
    assert "3 of 101 slots missed" in row.found
    assert "of 2 cores, 71 degrees" in row.found
    slow = replace(soak.timing.action, rate_hz=90.0)
    row = replace(soak, timing=replace(soak.timing, action=slow)).row()
    assert "does not hold the rate of chunks" in row.warn


def test_figures_of_the_computer_are_the_kernels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(computer, "PROC", tmp_path)
    monkeypatch.setattr(computer, "SYS", tmp_path)
    monkeypatch.setattr(computer.os, "sysconf", lambda _: 100)
    unknown = read_usage(FakeClock(), 7)
    assert (unknown.used_ns["guard"], unknown.guard_waited_ns, unknown.host_ns) == (0, 0, 0)
    assert (hottest_c(), this_computer().model) == (None, "")
    files = {
        "7/schedstat": "5000000 3000000 12\n",
        "stat": "cpu  100 0 50 9000 3 0 7 4 0 0\ncpu0 50 0 25 4500 1 0 3 1 0 0\n",
        "cpuinfo": "processor\t: 0\nmodel name\t: Some CPU\n",
        "device-tree/model": "Raspberry Pi 5\0",
        "class/thermal/thermal_zone0/temp": "48500\n",
        "class/thermal/thermal_zone1/temp": "61000\n",
        "class/thermal/thermal_zone2/temp": "unknown\n",
    }
    for name, text in files.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    known = read_usage(FakeClock(), 7)
    assert (known.used_ns["guard"], known.guard_waited_ns) == (5 * NS_PER_MS, 3 * NS_PER_MS)
    assert known.host_ns == 40 * NS_PER_MS
    here = this_computer()
    assert (here.model, here.cpu, hottest_c()) == ("Raspberry Pi 5", "Some CPU", 61.0)
