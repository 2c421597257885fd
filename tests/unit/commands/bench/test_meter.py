from pathlib import Path

import pytest

from helpers.factories import make_released_tick, make_tick, make_vision_tick
from mavbridge.commands.bench import meter as meter_module
from mavbridge.commands.bench.meter import FlightMeter, since_ms, stolen_ns
from mavbridge.observe.timing import TimingReport


def report_of(meter: FlightMeter) -> TimingReport:
    return meter.report(engine="torch", policy="toge", link=None)


def test_what_comes_before_the_first_action_does_not_count() -> None:
    meter = FlightMeter(action_hz=100, vision_hz=30)
    for index in range(50):
        meter.emit(make_released_tick(index))
        meter.emit(make_vision_tick(index))
    for index in range(100, 112):
        meter.emit(make_tick(index, missed_slots=50 if index == 100 else 0))
    report = report_of(meter)
    assert report.action.ticks == 11  # the first only starts the clock
    assert report.action.missed_slots == 0
    assert report.action.rate_hz == pytest.approx(100)
    assert report.vision.frames == 0


def test_slots_missed_in_flight_count() -> None:
    meter = FlightMeter(action_hz=100, vision_hz=30)
    for index in (0, 1, 2, 5, 6):
        meter.emit(make_tick(index, missed_slots=2 if index == 5 else 0))
    assert report_of(meter).action.missed_slots == 2


def test_images_in_flight_count() -> None:
    meter = FlightMeter(action_hz=100, vision_hz=30)
    meter.emit(make_tick(0))
    for index in range(3):
        meter.emit(make_vision_tick(index))
    assert report_of(meter).vision.frames == 3


def test_processor_time_runs_from_the_first_action() -> None:
    meter = FlightMeter(action_hz=100, vision_hz=30)
    meter.emit(make_tick(0))
    sum(range(200_000))
    meter.emit(make_tick(1))
    assert meter.cpu_ns > 0


STAT = "cpu  100 0 50 9000 3 0 7 {} 0 0\ncpu0 50 0 25 4500 1 0 3 1 0 0\n"


def test_stolen_time_is_what_the_kernel_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stat = tmp_path / "stat"
    monkeypatch.setattr(meter_module, "_PROC_STAT", stat)
    monkeypatch.setattr(meter_module.os, "sysconf", lambda _: 100)
    stat.write_text(STAT.format(20))
    before_ns = stolen_ns()
    stat.write_text(STAT.format(23))
    assert since_ms(before_ns, stolen_ns()) == 30.0


@pytest.mark.parametrize("text", [None, "cpu  100 0 50\n"])
def test_stolen_time_is_unknown_where_nobody_counts_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str | None
) -> None:
    stat = tmp_path / "stat"
    monkeypatch.setattr(meter_module, "_PROC_STAT", stat)
    if text is not None:
        stat.write_text(text)
    assert stolen_ns() is None
    assert since_ms(None, 5) is None
