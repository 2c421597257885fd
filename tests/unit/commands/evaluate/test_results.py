import math

import pytest

from helpers.evaluated_flights import FINISHED, crashed, finished
from helpers.factories import make_released_tick, make_tick, make_trace, make_vision_tick
from mavbridge.commands.evaluate import mean, rate, summarise
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.vehicle import NEUTRAL, Sticks
from mavbridge.simulation.referee import StickMeter
from sitl.course import make_course

GATES = make_course(FINISHED.course_seed).gates
LEG_M = math.dist(GATES[0].center_ned_m, GATES[1].center_ned_m)


def test_the_figures_of_three_flights() -> None:
    # One gate has no leg: the speed from gate to gate is that of the two others.
    summary = summarise([finished(), crashed(), finished(gate_times_s=(3.0, 6.0), flown_s=7.5)])
    values = {name: found and (found.value, found.count) for name, found in summary.items()}
    assert values == {
        "success_rate": (pytest.approx(2 / 3), 3),
        "gates_passed": (pytest.approx(5 / 3), 3),
        "mean_speed_mps": (pytest.approx((3.0 + 6.0 + 4.0) / 3), 3),
        "course_speed_mps": (pytest.approx(LEG_M * (1 / 5 + 1 / 3) / 2), 2),
        "stick_rate_per_s": (0.5, 2),
        "flown_s": (pytest.approx(22.5 / 3), 3),
        "course_s": (7.5, 2),
        "drift_m": None,
    }


def test_stick_movement_counts_only_what_the_policy_sent_in_a_row() -> None:
    meter = StickMeter()
    full_yaw = Sticks(throttle=0.0, yaw=1.0, pitch=0.0, roll=0.0)
    half = Sticks(throttle=0.5, yaw=0.5, pitch=0.5, roll=0.5)
    meter.emit(make_released_tick(0))
    assert meter.engaged_ns is None
    assert meter.rate_per_s is None
    meter.emit(make_tick(1, sent=NEUTRAL, trace=make_trace()))
    meter.emit(make_vision_tick())
    meter.emit(make_tick(2, sent=full_yaw, trace=make_trace(full_yaw)))  # 1 in 10 ms
    meter.emit(make_released_tick(3))
    meter.emit(make_tick(4, sent=half, trace=make_trace(half)))  # not compared across the release
    meter.emit(make_tick(5, sent=half, trace=make_trace(half)))  # 0 in 10 ms
    assert meter.engaged_ns == make_tick(1).woke_ns
    assert meter.rate_per_s == pytest.approx(1 / 4 / (20 * NS_PER_MS / 1e9))


@pytest.mark.parametrize(
    ("successes", "count", "low", "high"),
    [  # Wilson's interval with z = 1.96, by hand
        (8, 10, 0.4902, 0.9433),
        (0, 10, 0.0, 0.2775),
        (50, 100, 0.4038, 0.5962),
    ],
)
def test_intervals_are_those_of_the_textbook(
    successes: int, count: int, low: float, high: float
) -> None:
    estimate = rate(successes, count)
    assert estimate.value == successes / count
    assert (estimate.low, estimate.high) == pytest.approx((low, high), abs=1e-4)


def test_the_interval_of_a_mean_is_that_of_its_standard_error() -> None:
    spread = mean([float(value) for value in range(100)])
    # Mean 49.5, deviation 28.87, standard error 2.887.
    assert spread.low == pytest.approx(49.5 - 1.96 * 2.887, abs=0.3)
    assert spread.high == pytest.approx(49.5 + 1.96 * 2.887, abs=0.3)
