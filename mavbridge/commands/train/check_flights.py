"""The closed-loop check of a training run: a few courses, flown in lockstep."""

from pathlib import Path

from mavbridge.config.courses import CHECK_COURSE_SEED
from mavbridge.config.policy import PolicyConfig
from mavbridge.core.clock import MonotonicClock
from mavbridge.flight.policies import load_configured_policy
from mavbridge.simulation.flight import SimulatedFlight


def share_of_gates(checkpoint: Path, policy: str, flights: int) -> float:
    """Fly a checkpoint at two rates over ``flights`` courses; the share of gates passed, 0 to 1.

    Raises:
        MavbridgeError, PolicyError: it cannot be flown.
    """
    wanted = PolicyConfig(policy=policy, checkpoint=checkpoint, dual_rate=True, head_steps=0)
    passed = total = 0
    with load_configured_policy(wanted, MonotonicClock()) as loaded:
        for index in range(flights):
            flight = SimulatedFlight(course_seed=CHECK_COURSE_SEED + index, seed=index)
            result = flight.fly(loaded.executable)
            passed, total = passed + result.gates_passed, total + result.gates_total
    return passed / total
