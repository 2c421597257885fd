"""The shipped policies fly races and loops, stop at the end, and stay there."""

from dataclasses import replace

import pytest

from mavbridge.config.episodes import AutopilotKind
from mavbridge.config.policy import PolicyConfig
from mavbridge.core.clock import MonotonicClock
from mavbridge.flight.policies import load_configured_policy
from mavbridge.simulation.flight import SimulatedFlight
from mavbridge.simulation.world import NOMINAL, make_vehicle
from sitl.course import LOOP_SEEDS

RACE, EASY = 1_001_000_007, 1_000_007
WIND = replace(NOMINAL, wind_ned_mps=(1.0, -1.0, 0.0), gust_rms_mps=0.5)


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
@pytest.mark.parametrize(
    ("policy", "course", "most_m"), [("toge", EASY, 1.0), ("toge-rates", RACE, 2.0)]
)
def test_it_stays_where_it_stopped_in_wind(
    policy: str, course: int, most_m: float, autopilot: AutopilotKind
) -> None:
    """By rates, ArduPilot lands from 8 m height, and this wind moves it on its way down."""
    vehicle = make_vehicle(autopilot=autopilot, conditions=WIND)
    flight = SimulatedFlight(course_seed=course, seed=0, vehicle=vehicle)
    with load_configured_policy(PolicyConfig(policy=policy), MonotonicClock()) as loaded:
        result = flight.fly(loaded.runner, run_out_s=30.0)
    assert (result.outcome, result.gates_passed) == ("finished", result.gates_total)
    assert result.drift_m is not None
    assert result.drift_m < most_m


@pytest.mark.parametrize("policy", ["toge", "toge-rates"])
def test_it_flies_two_laps_of_a_loop(policy: str) -> None:
    flight = SimulatedFlight(course_seed=LOOP_SEEDS + 1_000_007, seed=0, laps=2)
    with load_configured_policy(PolicyConfig(policy=policy), MonotonicClock()) as loaded:
        result = flight.fly(loaded.runner)
    assert (result.outcome, result.gates_passed) == ("finished", 16)


@pytest.mark.parametrize(
    ("policy", "autopilot", "course", "gates"),
    [
        (PolicyConfig(policy="toge-rates"), "ardupilot", RACE, 3),
        (PolicyConfig(policy="toge-rates"), "px4", RACE, 2),
        (PolicyConfig(by_rates=True), "ardupilot", EASY, 2),
    ],
    ids=["race", "race on px4", "sticks by rates"],
)
def test_gates_are_passed_by_body_rates(
    policy: PolicyConfig, autopilot: AutopilotKind, course: int, gates: int
) -> None:
    flight = SimulatedFlight(course_seed=course, seed=0, vehicle=make_vehicle(autopilot=autopilot))
    with load_configured_policy(policy, MonotonicClock()) as loaded:
        assert loaded.runner.contract.action == "rates"
        result = flight.fly(loaded.runner, max_time_s=15.0)
    assert result.gates_passed >= gates, result
