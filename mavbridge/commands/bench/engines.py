"""The engines that are compared: the one list, how a policy is loaded on each, what is asked."""

import torch

from mavbridge.core.clock import NS_PER_S, MonotonicClock
from policy.checkpoints.policy_file import BuiltinPolicy, build_policy, load_checkpoint
from policy.contract import Executable
from policy.engines.executable import EngineName
from policy.loading import SHIPPED, PolicyRequest, load_policy
from policy.nets.toge import Toge, TogeConfig

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
SHIPPED_POLICY = "toge"
"""The trained weights that ``--policy toge`` is."""


def load(policy: str, engine: EngineName, *, head_steps: int | None = None) -> Executable:
    """A policy in dual rate on one engine; all but the shipped one have seeded random weights.

    Raises:
        PolicyError: the engine cannot run here.
    """
    clock = MonotonicClock()
    request = PolicyRequest(
        spec=policy,
        allow_untrained=policy != SHIPPED_POLICY,
        engine=engine,
        num_diffusion_steps=STEPS,
        head_steps=head_steps,
        seed=SEED,
    )
    executable = load_policy(request, now_s=lambda: clock.now_ns() / NS_PER_S).executable
    if not executable.engine.startswith(engine):  # it may name its precisions, too
        raise ValueError(f"asked for the engine {engine}, got {executable.engine}")
    return executable


def eager_toge(config: TogeConfig) -> Toge:
    """The network alone, with seeded random weights."""
    torch.manual_seed(SEED)
    return _toge(build_policy(config))


def shipped_toge() -> Toge:
    """The network of ``SHIPPED_POLICY`` alone."""
    return _toge(load_checkpoint(SHIPPED, fallback=TogeConfig()))


def _toge(policy: BuiltinPolicy) -> Toge:
    if not isinstance(policy, Toge):
        raise TypeError(f"not a Toge: {type(policy).__name__}")
    policy.eval()
    policy.reset(SEED)
    return policy
