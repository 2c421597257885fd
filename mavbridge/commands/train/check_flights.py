"""The closed-loop check of a training run: a few courses, flown in lockstep."""

from pathlib import Path

from mavbridge.config.courses import CHECK_COURSE_SEED, first_seed
from mavbridge.config.policy import PolicyConfig
from mavbridge.core.clock import MonotonicClock
from mavbridge.flight.policies import load_configured_policy
from mavbridge.simulation.flight import SimulatedFlight
from policy.training.settings import TrainSettings


def share_of_gates(checkpoint: Path, settings: TrainSettings) -> float:
    """Fly a checkpoint at two rates over ``check_flights`` courses; the share of gates passed.

    Raises:
        MavbridgeError, PolicyError: it cannot be flown.
    """
    wanted = PolicyConfig(policy=settings.policy, checkpoint=checkpoint, dual_rate=True)
    first, passed, total = first_seed(settings.check_courses) + CHECK_COURSE_SEED, 0, 0
    with load_configured_policy(wanted, MonotonicClock()) as loaded:
        for index in range(settings.check_flights):
            flight = SimulatedFlight(course_seed=first + index, seed=index)
            result = flight.fly(loaded.executable)
            passed, total = passed + result.gates_passed, total + result.gates_total
    return passed / total
