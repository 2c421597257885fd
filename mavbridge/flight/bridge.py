"""Composition of the flight process's loops, shared by real flights and the simulation."""

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import chain

from mavbridge.camera.image_watch import ImageWatch
from mavbridge.config.flight import CameraConfig
from mavbridge.config.rates import LoopRates
from mavbridge.core.clock import NS_PER_MS, NS_PER_S, Clock
from mavbridge.core.observers import FanOut
from mavbridge.core.ports import Camera, TickSink
from mavbridge.core.records import CameraImage, FloatArray, Solve
from mavbridge.core.vehicle import ForwardedPacket
from mavbridge.flight.action_frames import action_frame
from mavbridge.flight.feature_cache import FeatureCache
from mavbridge.flight.forward_state import ForwardState
from mavbridge.flight.history import SentHistory
from mavbridge.flight.plan import FlightPlan
from mavbridge.flight.policy_loop import PolicyLoop, PolicySettings
from mavbridge.flight.state import Freshness, ObservationSource, StateReader, observation_ages_ns
from mavbridge.flight.telemetry_cache import TelemetryCache
from mavbridge.flight.vision_loop import VisionLoop
from mavbridge.flight.vision_rate import AdaptiveRate
from mavbridge.guard.channel import SocketPort
from mavbridge.guard.chunks import Chunk
from mavbridge.guard.wire import NoChunk
from policy.contract import Contract
from policy.protocol import PolicyRunner

SPARSE_NS = 50 * NS_PER_MS
"""At longer chunk periods the states of the chunks are too sparse for the motion since an exposure:
the states between two chunks are kept as well."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Bridge:
    """Vision loops, policy loop and telemetry of one flight."""

    visions: tuple[VisionLoop, ...]
    """One loop per camera, in the contract's order."""
    policy: PolicyLoop
    view: TelemetryCache


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraPath:
    """Per-camera resources."""

    camera: Camera
    """Read by the camera's vision loop only."""
    cache: FeatureCache
    """Features of this camera. In simulation a feature appears when its simulated encoding ends."""
    clock: Clock
    """Clock of the camera's vision loop."""


def build_bridge(
    plan: FlightPlan,
    runner: PolicyRunner,
    *,
    clock: Clock,
    send: Callable[[Chunk | NoChunk], object],
    cameras: Sequence[CameraPath],
    sinks: Sequence[TickSink],
    watches_images: bool,
    all_cameras: Sequence[TickSink] = (),
    watch_solve: Callable[[Solve], object] | None = None,
    watch_packets: Callable[[tuple[ForwardedPacket, ...]], object] = lambda packets: None,
    samples: SocketPort | None = None,
    delay_vision: Callable[[TickSink], TickSink] | None = None,
) -> Bridge:
    """Join a policy, its cameras and the guard.

    Args:
        plan: of the flight; its cameras and address are not used.
        runner: the policy on its engine.
        clock: time of the policy loop; in simulation its solves take simulated time.
        send: hands a chunk to the guard, or the reason why there is none.
        cameras: those of the contract, in its order.
        sinks: see every tick and every encoded frame of the first camera.
        watches_images: a frozen or a black image is a fault; False where nobody looks at it.
        all_cameras: see the encoded frames of the other cameras, each in the thread of its own.
        watch_solve: is given every solve, in the thread of the policy; must not block.
        watch_packets: is given every packet of the vehicle, where the guard passes them on; must
            not block.
        samples: where the vehicle's readings come from, if not with the guard's other messages.
        delay_vision: wraps the sink of each vision loop, where encoding takes simulated time.
    """
    config, contract, limits = plan.config, plan.contract, plan.start_limits
    freshness = Freshness(attitude_ns=limits.state_ns, velocity_ns=limits.velocity_ns)
    reader = StateReader(contract, freshness=freshness, goal_ned_m=config.goal_ned_m)
    settings = PolicySettings(
        action_frame=action_frame(contract),
        chunk_dt_s=contract.chunk_dt_s,
        forward=ForwardState(contract) if contract.state_time == "execution" else None,
        prefix_len=contract.prefix_len,
        max_frozen_ns=round(config.limits.max_frozen_state * NS_PER_S),
        period_ns=plan.guard.chunk_period_ns,
    )
    span_ns = _states_span_ns(contract, settings.period_ns, limits.feature_ns)
    history = SentHistory(
        length=contract.history_len, dt_s=contract.history_dt_s, frame=settings.action_frame
    )
    rates = _visual_rates(contract, plan.loops)
    adaptive = [[rate] if rate.is_adaptive else [] for rate in rates]
    view = TelemetryCache(
        history=history,
        sink=FanOut([*chain(*adaptive), *sinks]),
        state_frame=contract.state_frame,
        freshness=freshness,
        samples=samples,
        keeps_past=span_ns > 0,
        watch_packets=watch_packets,
    )
    vision_sinks: list[TickSink] = [
        FanOut([*own, *(all_cameras if number else sinks)]) for number, own in enumerate(adaptive)
    ]
    visions = _vision_loops(
        runner,
        cameras,
        rates=rates,
        sinks=[delay_vision(sink) for sink in vision_sinks] if delay_vision else vision_sinks,
        watch=config.camera if watches_images else None,
        is_airborne=lambda: view.is_airborne,
    )
    policy = PolicyLoop(
        clock=clock,
        view=view,
        reader=reader,
        observations=ObservationSource(
            contract,
            caches=[path.cache for path in cameras],
            join=runner.join,
            max_feature_age_ns=limits.feature_ns,
            states_span_ns=span_ns,
        ),
        history=history,
        act=runner.act,
        reset=runner.reset,
        send=send,
        settings=settings,
        watch=watch_solve,
    )
    return Bridge(visions=visions, policy=policy, view=view)


def _vision_loops(
    runner: PolicyRunner,
    cameras: Sequence[CameraPath],
    *,
    rates: Sequence[AdaptiveRate],
    sinks: Sequence[TickSink],
    watch: CameraConfig | None,
    is_airborne: Callable[[], bool],
) -> tuple[VisionLoop, ...]:
    """Build the vision loop of each camera. ``watch``: check images for faults; None: do not."""
    encoder_lock = threading.Lock()
    return tuple(
        VisionLoop(
            camera=path.camera,
            encode=_encoder(runner, number),
            cache=path.cache,
            sink=sink,
            clock=path.clock,
            period_ns=rate.period_ns,
            encoder_lock=encoder_lock,
            image_watch=None if watch is None else _image_watch(watch),
            is_airborne=is_airborne,
            number=number,
        )
        for number, (path, rate, sink) in enumerate(zip(cameras, rates, sinks, strict=True))
    )


def _states_span_ns(contract: Contract, chunk_period_ns: int, feature_ns: int) -> int:
    """Return for how long past states are kept: for past observations, and for the motion since an
    exposure."""
    is_sparse = contract.since_exposure and chunk_period_ns > SPARSE_NS
    return observation_ages_ns(contract)[0] + (feature_ns if is_sparse else 0)


def _visual_rates(contract: Contract, loops: LoopRates) -> list[AdaptiveRate]:
    """Return the rate of each camera: the flight's, or the contract's if that is lower."""
    return [
        AdaptiveRate(min_hz=min(loops.min_vision_hz, hz), max_hz=min(loops.max_vision_hz, hz))
        for hz in contract.camera_rates_hz or (loops.max_vision_hz,) * len(contract.cameras)
    ]


def _encoder(runner: PolicyRunner, camera: int) -> Callable[[CameraImage], FloatArray]:
    return runner.encode if camera == 0 else lambda rgb: runner.encode(rgb, camera)


def _image_watch(config: CameraConfig) -> ImageWatch:
    return ImageWatch(max_frozen_s=config.max_frozen_image, max_black_s=config.max_black_image)
