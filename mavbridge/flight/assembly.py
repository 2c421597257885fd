"""From a flight's config to its policy and its two loops, whatever clock, link and camera."""

import sys
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

from mavbridge.config.flight import FlyConfig, Limits
from mavbridge.config.policy import PolicyConfig
from mavbridge.config.rates import Rates, period_ns
from mavbridge.core.clock import NS_PER_S, Clock, GridPacer, MonotonicClock, Pacer
from mavbridge.core.ports import Camera, Link, TickSink
from mavbridge.flight.action_loop import ActionLoop, ActionSettings
from mavbridge.flight.feature_cache import FeatureCache
from mavbridge.flight.state import Freshness
from mavbridge.flight.state_pacer import StatePacer
from mavbridge.flight.vision_loop import VisionLoop
from mavbridge.gate.engagement import Engagement
from mavbridge.gate.smoothing import Smoothing, StickSmoother
from policy.contract import Executable
from policy.loading import LoadedPolicy, PolicyRequest, load_policy

BUILT_IN = ("toge", "resnet-unet")


def load_configured_policy(wanted: PolicyConfig, clock: Clock) -> LoadedPolicy:
    """The policy that the flags ask for; scripted ones follow ``clock``.

    Raises:
        PolicyError: with what was wrong, what was available and what to do.
    """
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.append(here)  # a person's own module:Class lies where they work
    request = PolicyRequest(
        spec=wanted.policy,
        checkpoint=wanted.checkpoint,
        allow_untrained=wanted.allow_untrained,
        engine=wanted.engine,
        device=wanted.device,
        vision_device=wanted.vision_device,
        action_device=wanted.action_device,
        dual_rate=wanted.dual_rate,
        num_diffusion_steps=wanted.num_diffusion_steps,
        head_steps=wanted.head_steps,
        image_size=wanted.image_size,
        seed=wanted.seed,
    )
    return load_policy(request, now_s=lambda: clock.now_ns() / NS_PER_S)


def is_stateless(policy: PolicyConfig) -> bool:
    """A built-in net, which starts afresh with each flight; anything else may remember the last."""
    return policy.policy.partition(":")[0] in BUILT_IN


@lru_cache(maxsize=1)
def _loaded_once(policy: PolicyConfig) -> LoadedPolicy:
    return load_configured_policy(policy, MonotonicClock())


def load_for_episodes(policy: PolicyConfig, clock: Clock) -> LoadedPolicy:
    """A policy that knows nothing of earlier flights; nets are loaded once in a process.

    Raises:
        PolicyError: it cannot be loaded.
    """
    if is_stateless(policy):
        return _loaded_once(policy)
    return load_configured_policy(policy, clock)


def action_rate_hz(rates: Rates, *, is_dual: bool) -> float:
    """Commands a second."""
    return rates.action_rate if is_dual else rates.rate


def vision_limits_hz(rates: Rates, *, is_dual: bool) -> tuple[float, float]:
    """Least and most frames a second; equal where the rate is fixed."""
    return rates.visual_limits_hz if is_dual else (rates.rate, rates.rate)


def make_vision_loop(
    executable: Executable,
    *,
    clock: Clock,
    camera: Camera,
    cache: FeatureCache,
    sink: TickSink,
    period_ns: Callable[[], int],
) -> VisionLoop:
    """The slow path of one flight."""
    return VisionLoop(
        camera=camera,
        encode=executable.encode,
        cache=cache,
        sink=sink,
        clock=clock,
        period_ns=period_ns,
    )


def make_action_loop(
    config: FlyConfig,
    executable: Executable,
    *,
    clock: Clock,
    link: Link,
    cache: FeatureCache,
    sink: TickSink,
) -> ActionLoop:
    """The fast path of one flight."""
    contract = executable.contract
    action_hz = action_rate_hz(config.rates, is_dual=executable.dual_rate)
    action_period_ns = period_ns(action_hz)
    smoothing = Smoothing(max_slew_per_s=config.limits.max_slew, tau_s=config.limits.tau)
    pacer: Pacer
    if config.rates.pace == "state":
        pacer = StatePacer(clock, link, period_ns=action_period_ns)
    else:
        pacer = GridPacer(clock, period_ns=action_period_ns)
    return ActionLoop(
        clock=clock,
        pacer=pacer,
        link=link,
        cache=cache,
        act=executable.act,
        smoother=StickSmoother(smoothing),
        engagement=Engagement(
            wanted_mode=config.mode, arm=config.arm, readonly=config.link.readonly
        ),
        sink=sink,
        settings=ActionSettings(
            state_frame=contract.state_frame,
            since_exposure=contract.since_exposure,
            chunk_dt_s=contract.chunk_dt_s,
            history_len=contract.history_len,
            history_dt_s=contract.history_dt_s,
            freshness=_freshness(config.limits),
            max_feature_age_ns=round(config.limits.max_feature_age * NS_PER_S),
            lead_s=config.limits.tau,
            mode=config.mode,
            duration_ns=None if config.duration is None else round(config.duration * NS_PER_S),
        ),
    )


def _freshness(limits: Limits) -> Freshness:
    return Freshness(
        attitude_ns=round(limits.max_attitude_age * NS_PER_S),
        velocity_ns=round(limits.max_velocity_age * NS_PER_S),
    )
