"""The engines that are compared: the one list, how a policy is loaded on each, what is asked."""

from mavbridge.clock import NS_PER_S, MonotonicClock
from policy.contract import Executable
from policy.loading import load_policy

EAGER = "torch"
ENGINES = (EAGER,)
"""The eager form first."""
SEED = 0
"""Of the untrained weights and the initial noise: every process makes the same policy of it."""
STEPS = 10
"""DDIM steps of a chunk."""
FLIGHT_POLICY = "toge:small"


def load(policy: str, engine: str) -> Executable:
    """A policy with seeded random weights, in dual rate, on one engine.

    Raises:
        PolicyError: the engine cannot run here.
    """
    clock = MonotonicClock()
    executable = load_policy(
        policy,
        checkpoint=None,
        allow_untrained=True,
        device="cpu",
        dual_rate=True,
        num_diffusion_steps=STEPS,
        image_size=None,
        seed=SEED,
        now_s=lambda: clock.now_ns() / NS_PER_S,
    ).executable
    if executable.engine != engine:
        raise ValueError(f"asked for the engine {engine}, got {executable.engine}")
    return executable
