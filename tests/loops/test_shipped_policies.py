"""The shipped policies fly races and loops, stop at the end, and stay there."""

from collections.abc import Iterator
from dataclasses import replace

import pytest

from mavbridge.config.episodes import AutopilotKind
from mavbridge.config.policy import PolicyConfig
from mavbridge.core.clock import MonotonicClock
from mavbridge.flight.policies import load_configured_policy
from mavbridge.simulation.flight import SimulatedFlight
from mavbridge.simulation.world import NOMINAL, make_vehicle
from policy.protocol import PolicyRunner
from sitl.course import LOOP_SEEDS

RACE, EASY = 1_001_000_007, 1_000_007
WIND = replace(NOMINAL, wind_ned_mps=(1.0, -1.0, 0.0), gust_rms_mps=0.5)


@pytest.fixture(scope="module")
def rates() -> Iterator[PolicyRunner]:
    """``toge-rates``, loaded once: that takes as long as half a race."""
    with load_configured_policy(PolicyConfig(policy="toge-rates"), MonotonicClock()) as loaded:
        assert loaded.runner.contract.action == "rates"
        yield loaded.runner


def stays_in_wind(
    runner: PolicyRunner, course: int, autopilot: AutopilotKind, most_m: float
) -> None:
    vehicle = make_vehicle(autopilot=autopilot, conditions=WIND)
    flight = SimulatedFlight(course_seed=course, seed=0, vehicle=vehicle)
    result = flight.fly(runner, run_out_s=15.0)
    assert (result.outcome, result.gates_passed) == ("finished", result.gates_total)
    assert result.drift_m is not None
    assert result.drift_m < most_m


def test_by_sticks_it_stays_where_it_stopped_in_wind() -> None:
    with load_configured_policy(PolicyConfig(policy="toge"), MonotonicClock()) as loaded:
        stays_in_wind(loaded.runner, EASY, "px4", 1.0)


def test_by_rates_it_stays_where_it_stopped_in_wind(rates: PolicyRunner) -> None:
    """ArduPilot lands from 8 m height, and this wind moves it on its way down."""
    stays_in_wind(rates, RACE, "ardupilot", 2.0)


def test_it_flies_two_laps_of_a_loop(rates: PolicyRunner) -> None:
    flight = SimulatedFlight(course_seed=LOOP_SEEDS + 1_000_007, seed=0, laps=2)
    result = flight.fly(rates)
    assert (result.outcome, result.gates_passed) == ("finished", 16)


def passes_two_gates(
    runner: PolicyRunner, course: int, autopilot: AutopilotKind, within_s: float
) -> None:
    flight = SimulatedFlight(course_seed=course, seed=0, vehicle=make_vehicle(autopilot=autopilot))
    result = flight.fly(runner, max_time_s=within_s)
    assert result.gates_passed >= 2, result


def test_it_passes_gates_of_a_race_on_px4(rates: PolicyRunner) -> None:
    passes_two_gates(rates, RACE, "px4", 8.5)


def test_sticks_pass_gates_by_body_rates() -> None:
    with load_configured_policy(PolicyConfig(by_rates=True), MonotonicClock()) as loaded:
        assert loaded.runner.contract.action == "rates"
        passes_two_gates(loaded.runner, EASY, "ardupilot", 8.5)
