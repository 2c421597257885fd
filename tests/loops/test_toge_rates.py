"""The shipped policy by rates flies races on both firmwares, and the one by sticks as well."""

import pytest

from mavbridge.config.episodes import AutopilotKind
from mavbridge.config.policy import PolicyConfig
from mavbridge.core.clock import MonotonicClock
from mavbridge.flight.policies import load_configured_policy
from mavbridge.simulation.flight import SimulatedFlight
from mavbridge.simulation.world import make_vehicle

RACE, EASY = 1_001_000_007, 1_000_007


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
