"""The figures of a soak, and its row."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.factories import make_released_tick, make_state, make_tick
from helpers.fakes import FakeClock
from helpers.reports import report_of
from mavbridge.commands.check import computer
from mavbridge.commands.check.computer import (
    CLIMB_STICK,
    USAGE_NS,
    Soak,
    UsageMeter,
    climb_config,
    level_climb,
    require_whole,
)
from mavbridge.config.flight import FlyConfig
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.errors import PeerError
from mavbridge.core.realtime import usable_cores
from mavbridge.core.reasons import Code, because
from mavbridge.core.records import Tick
from policy.contract import Contract
from policy.protocol import PolicyRunner

RATES = Contract(action="rates", cameras=("left", "right"), feature_dim=2)


def make_runner(calls: list[int]) -> PolicyRunner:
    def act(*arguments: object) -> np.ndarray:
        calls.append(len(arguments))
        return np.ones((1, 16, 4), np.float32)

    names = {"name": "mine", "engine": "numpy"}
    return PolicyRunner(**names, contract=RATES, dual_rate=True, encode=lambda rgb: rgb, act=act)


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


WAITING = make_released_tick(0, phase="waiting")
FLOWN = tuple(make_tick(index, missed_slots=3 * (index == 50)) for index in range(1, 101))


@pytest.mark.parametrize(
    ("ticks", "wanted_s", "told"),
    [
        ((WAITING,), 1.0, "never had the sticks"),
        (
            (WAITING, *FLOWN, make_released_tick(101, because(Code.NO_CHUNK), phase="leaving")),
            1.0,
            "lost the sticks",
        ),
        ((WAITING, *FLOWN), 2.0, r"lasted 0\.99 s instead of 2 s"),
    ],
)
def test_a_flight_that_is_no_measurement_is_refused(
    ticks: tuple[Tick, ...], wanted_s: float, told: str
) -> None:
    with pytest.raises(PeerError, match=told):
        require_whole(report_of(*ticks), wanted_s)


def test_a_row_warns_of_missed_slots_and_of_rates_that_are_not_held() -> None:
    ended = make_released_tick(101, because(Code.DURATION, what="flight"), phase="leaving")
    report = report_of(WAITING, *FLOWN, ended)
    require_whole(report, 1.0)
    clock = FakeClock()
    meter = UsageMeter(clock, os.getpid())
    meter.emit(WAITING)
    meter.emit(FLOWN[0])
    sum(range(200_000))  # some processor time
    clock.advance_ns(USAGE_NS)
    meter.emit(FLOWN[-1])
    assert 0 < meter.cores["flight"] < 1
    measured = Soak(timing=report, cpu_cores=meter.cores, hottest_c=71.4)
    row = measured.row()
    assert row.verdict == "warn"
    assert "missed slots" in row.warn
    assert "rate" not in row.warn
    assert "3 of 100 slots missed" in row.found
    assert f"of {usable_cores()} cores, 71 degrees" in row.found
    slow = replace(report, action=replace(report.action, rate_hz=90.0))
    assert "does not hold the rate of chunks" in replace(measured, timing=slow).row().warn


def test_figures_of_the_computer_are_the_kernels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(computer, "PROC", tmp_path)
    monkeypatch.setattr(computer, "SYS", tmp_path)
    clock = FakeClock()
    meter = UsageMeter(clock, 7)
    meter.emit(FLOWN[0])
    assert (meter.cores["guard"], meter.hottest_c) == (0, None)
    files = {
        "7/schedstat": "5000000 3000000 12\n",
        "class/thermal/thermal_zone0/temp": "48500\n",
        "class/thermal/thermal_zone1/temp": "61000\n",
        "class/thermal/thermal_zone2/temp": "unknown\n",
    }
    for name, text in files.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    clock.advance_ns(USAGE_NS)
    meter.emit(FLOWN[1])
    assert meter.cores["guard"] == pytest.approx(5 * NS_PER_MS / USAGE_NS)
    assert meter.hottest_c == 61.0
