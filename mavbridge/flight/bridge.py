"""The loops of the flight process, composed once for a real vehicle and for the simulation."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from mavbridge.camera.image_watch import ImageWatch
from mavbridge.config.flight import CameraConfig, FlyConfig
from mavbridge.core.clock import NS_PER_S, Clock, period_ns
from mavbridge.core.observers import FanOut
from mavbridge.core.ports import Camera, TickSink
from mavbridge.flight.action_frames import action_frame
from mavbridge.flight.feature_cache import FeatureCache
from mavbridge.flight.history import SentHistory
from mavbridge.flight.policy_loop import PolicyLoop, PolicySettings
from mavbridge.flight.settings import effective_freshness
from mavbridge.flight.state import Freshness
from mavbridge.flight.vehicle_view import VehicleView
from mavbridge.flight.vision_loop import VisionLoop
from mavbridge.flight.vision_rate import AdaptiveRate
from mavbridge.gate.chunks import Chunk
from mavbridge.gate.wire import Absence
from policy.protocol import Executable


@dataclass(frozen=True, slots=True, kw_only=True)
class Bridge:
    """Camera to feature cache, state and feature to chunks, and what the gate says of both."""

    vision: VisionLoop
    policy: PolicyLoop
    view: VehicleView


def build_bridge(
    config: FlyConfig,
    executable: Executable,
    *,
    clock: Clock,
    send: Callable[[Chunk | Absence], object],
    camera: Camera,
    sinks: Sequence[TickSink],
    watches_images: bool,
    cache: FeatureCache | None = None,
    policy_clock: Clock | None = None,
    vision_clock: Clock | None = None,
    delay_vision: Callable[[TickSink], TickSink] | None = None,
) -> Bridge:
    """Join a policy, a camera and the gate.

    Args:
        config: rates and limits; its camera and address are not used.
        executable: the policy on its engine.
        clock: time of everything that has no clock of its own.
        send: hands a chunk to the gate, or the reason why there is none.
        camera: used by the vision loop alone.
        sinks: see every tick and every encoded frame.
        watches_images: a frozen or a black image is a fault; False where nobody looks at it.
        cache: holds the newest feature; simulation passes one that publishes late.
        policy_clock: time of the policy loop, where simulated solving takes simulated time.
        vision_clock: time of the vision loop, likewise.
        delay_vision: wraps the sink of the vision loop, for the same reason.
    """
    cache = cache or FeatureCache()
    contract = executable.contract
    loops = config.rates.loops(is_dual=executable.dual_rate)
    rate = AdaptiveRate(min_hz=loops.min_vision_hz, max_hz=loops.max_vision_hz)
    sink = FanOut([rate, *sinks] if rate.is_adaptive else sinks)
    limits = effective_freshness(contract, config.limits)
    frame = action_frame(contract)
    settings = PolicySettings(
        state_frame=contract.state_frame,
        since_exposure=contract.since_exposure,
        action_frame=frame,
        chunk_dt_s=contract.chunk_dt_s,
        freshness=Freshness(attitude_ns=limits.state_ns, velocity_ns=limits.velocity_ns),
        max_feature_age_ns=limits.feature_ns,
        max_frozen_ns=round(config.limits.max_frozen_state * NS_PER_S),
        period_ns=period_ns(loops.action_hz),
    )
    history = SentHistory(length=contract.history_len, dt_s=contract.history_dt_s, frame=frame)
    view = VehicleView(
        history=history,
        sink=sink,
        state_frame=settings.state_frame,
        freshness=settings.freshness,
    )
    vision = VisionLoop(
        camera=camera,
        encode=executable.encode,
        cache=cache,
        sink=delay_vision(sink) if delay_vision else sink,
        clock=vision_clock or clock,
        period_ns=rate.period_ns,
        image_watch=_image_watch(config.camera) if watches_images else None,
        is_airborne=lambda: view.is_airborne,
    )
    policy = PolicyLoop(
        clock=policy_clock or clock,
        view=view,
        cache=cache,
        history=history,
        act=executable.act,
        reset=executable.reset,
        send=send,
        settings=settings,
    )
    return Bridge(vision=vision, policy=policy, view=view)


def _image_watch(config: CameraConfig) -> ImageWatch:
    return ImageWatch(max_frozen_s=config.max_frozen_image, max_black_s=config.max_black_image)
