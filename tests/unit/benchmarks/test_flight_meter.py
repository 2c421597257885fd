import pytest

from benchmarks.flight import FlightMeter
from helpers.factories import make_released_tick, make_tick, make_vision_tick


def test_what_comes_before_the_first_action_does_not_count() -> None:
    meter = FlightMeter(stick_hz=100, action_hz=100, vision_hz=30)
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


def test_slots_missed_in_flight_count() -> None:
    meter = FlightMeter(stick_hz=100, action_hz=100, vision_hz=30)
    for index in (0, 1, 2, 5, 6):
        meter.emit(make_tick(index, missed_slots=2 if index == 5 else 0))
    assert meter.report().sticks.missed_slots == 2


def test_images_in_flight_count() -> None:
    meter = FlightMeter(stick_hz=100, action_hz=100, vision_hz=30)
    meter.emit(make_tick(0))
    for index in range(3):
        meter.emit(make_vision_tick(index))
    assert meter.report().vision.frames == 3


def test_processor_time_runs_from_the_first_action() -> None:
    meter = FlightMeter(stick_hz=100, action_hz=100, vision_hz=30)
    meter.emit(make_tick(0))
    sum(range(200_000))
    meter.emit(make_tick(1))
    assert meter.cpu_ns > 0
