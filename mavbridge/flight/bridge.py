"""Both loops of a flight, composed once for a real vehicle and for the simulation."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from mavbridge.config.flight import FlyConfig
from mavbridge.core.clock import NS_PER_S, Clock, GridPacer, Pacer, period_ns
from mavbridge.core.observers import FanOut
from mavbridge.core.ports import Camera, Link, TickSink
from mavbridge.flight.action_loop import ActionLoop, ActionSettings
from mavbridge.flight.feature_cache import FeatureCache
from mavbridge.flight.state import Freshness
from mavbridge.flight.state_pacer import StatePacer
from mavbridge.flight.vision_loop import VisionLoop
from mavbridge.flight.vision_rate import AdaptiveRate
from mavbridge.gate.engagement import Engagement
from mavbridge.gate.smoothing import Smoothing, StickSmoother
from policy.contract import Executable


@dataclass(frozen=True, slots=True, kw_only=True)
class Bridge:
    """The two loops, joined by a feature cache; each is run by one thread, or stepped."""

    vision: VisionLoop
    action: ActionLoop


def build_bridge(
    config: FlyConfig,
    executable: Executable,
    *,
    clock: Clock,
    link: Link,
    camera: Camera,
    sinks: Sequence[TickSink],
    cache: FeatureCache | None = None,
    vision_clock: Clock | None = None,
    delay_vision: Callable[[TickSink], TickSink] | None = None,
) -> Bridge:
    """Join a policy, a camera and a link.

    Args:
        config: rates, limits, mode and arming; its camera and address are not used.
        executable: the policy on its engine.
        clock: time of the action loop, and of the vision loop if it has none of its own.
        link: the vehicle; used by the action loop alone.
        camera: used by the vision loop alone.
        sinks: see every tick and every encoded frame.
        cache: holds the newest feature; simulation passes one that publishes late.
        vision_clock: time of the vision loop, where simulated encoding takes simulated time.
        delay_vision: wraps the sink of the vision loop, for the same reason.
    """
    cache = cache or FeatureCache()
    loops = config.rates.loops(is_dual=executable.dual_rate)
    rate = AdaptiveRate(min_hz=loops.min_vision_hz, max_hz=loops.max_vision_hz)
    sink = FanOut([rate, *sinks] if rate.is_adaptive else sinks)
    vision = VisionLoop(
        camera=camera,
        encode=executable.encode,
        cache=cache,
        sink=delay_vision(sink) if delay_vision else sink,
        clock=vision_clock or clock,
        period_ns=rate.period_ns,
    )
    action = build_action_loop(config, executable, clock=clock, link=link, cache=cache, sink=sink)
    return Bridge(vision=vision, action=action)


def build_action_loop(
    config: FlyConfig,
    executable: Executable,
    *,
    clock: Clock,
    link: Link,
    cache: FeatureCache,
    sink: TickSink,
) -> ActionLoop:
    """Build the fast path alone; arguments as for ``build_bridge``."""
    action_period_ns = period_ns(config.rates.loops(is_dual=executable.dual_rate).action_hz)
    pacer: Pacer = GridPacer(clock, period_ns=action_period_ns)
    if config.rates.pace == "state":
        pacer = StatePacer(clock, link, period_ns=action_period_ns)
    contract, limits = executable.contract, config.limits
    settings = ActionSettings(
        state_frame=contract.state_frame,
        since_exposure=contract.since_exposure,
        chunk_dt_s=contract.chunk_dt_s,
        history_len=contract.history_len,
        history_dt_s=contract.history_dt_s,
        freshness=Freshness(
            attitude_ns=round(limits.max_attitude_age * NS_PER_S),
            velocity_ns=round(limits.max_velocity_age * NS_PER_S),
        ),
        max_feature_age_ns=round(limits.max_feature_age * NS_PER_S),
        lead_s=limits.tau,
        mode=config.mode,
        duration_ns=None if config.duration is None else round(config.duration * NS_PER_S),
    )
    return ActionLoop(
        clock=clock,
        pacer=pacer,
        link=link,
        cache=cache,
        act=executable.act,
        smoother=StickSmoother(Smoothing(max_slew_per_s=limits.max_slew, tau_s=limits.tau)),
        engagement=Engagement(
            wanted_mode=config.mode, arm=config.arm, readonly=config.link.readonly
        ),
        sink=sink,
        settings=settings,
    )
