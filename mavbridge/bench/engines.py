"""The engines that are compared: the one list, how a policy is loaded on each, what is asked."""

from mavbridge.clock import NS_PER_S, MonotonicClock
from policy.contract import Executable
from policy.engines.executable import EngineName
from policy.loading import load_policy

EAGER: EngineName = "torch"
ENGINES: tuple[EngineName, ...] = (EAGER, "openvino")
"""The eager form first."""
WARM_STEPS = 2
"""Of a chunk that starts from the last one."""
SEED = 0
"""Of the untrained weights and the initial noise: every process makes the same policy of it."""
STEPS = 10
"""DDIM steps of a chunk."""
FLIGHT_POLICY = "toge:small"


def load(policy: str, engine: EngineName, *, head_steps: int | None = None) -> Executable:
    """A policy with seeded random weights, in dual rate, on one engine.

    Raises:
        PolicyError: the engine cannot run here.
    """
    clock = MonotonicClock()
    executable = load_policy(
        policy,
        checkpoint=None,
        allow_untrained=True,
        engine=engine,
        device="cpu",
        dual_rate=True,
        num_diffusion_steps=STEPS,
        head_steps=head_steps,
        image_size=None,
        seed=SEED,
        now_s=lambda: clock.now_ns() / NS_PER_S,
    ).executable
    if not executable.engine.startswith(engine):  # it may name its precisions, too
        raise ValueError(f"asked for the engine {engine}, got {executable.engine}")
    return executable
