"""Composition of the flight process's loops, shared by real flights and the simulation."""

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from mavbridge.camera.image_watch import ImageWatch
from mavbridge.core.clock import Clock, period_ns
from mavbridge.core.observers import FanOut
from mavbridge.core.reasons import Reason
from mavbridge.core.records import Camera, Solve, TickSink
from mavbridge.core.vehicle import ForwardedPacket
from mavbridge.flight.feature_cache import FeatureCache
from mavbridge.flight.plan import FlightPlan
from mavbridge.flight.policy_loop import PolicyLoop
from mavbridge.flight.telemetry_cache import TelemetryCache
from mavbridge.flight.vision_loop import VisionLoop
from mavbridge.guard.channel import SocketPort
from mavbridge.guard.chunks import Chunk
from policy.protocol import PolicyRunner


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
    send: Callable[[Chunk | Reason], object],
    cameras: Sequence[CameraPath],
    sinks: Sequence[TickSink],
    watches_images: bool,
    all_cameras: Sequence[TickSink] = (),
    watch_solve: Callable[[Solve], object] | None = None,
    watch_packets: Callable[[tuple[ForwardedPacket, ...]], object] = lambda packets: None,
    samples: SocketPort | None = None,
    delay_vision: Callable[[TickSink], TickSink] = lambda sink: sink,
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
    camera = plan.config.camera
    view = TelemetryCache(plan, sink=FanOut(sinks), samples=samples, watch_packets=watch_packets)
    encoder_lock = threading.Lock()
    visions = []
    for number, (path, rate_hz) in enumerate(zip(cameras, plan.image_rates_hz, strict=True)):
        watch: ImageWatch | None = None
        if watches_images:
            watch = ImageWatch(
                max_frozen_s=camera.max_frozen_image, max_black_s=camera.max_black_image
            )
        vision = VisionLoop(
            camera=path.camera,
            encode=runner.encode,
            cache=path.cache,
            sink=delay_vision(FanOut(all_cameras if number else sinks)),
            clock=path.clock,
            period_ns=period_ns(rate_hz),
            encoder_lock=encoder_lock,
            image_watch=watch,
            is_airborne=lambda: view.is_airborne,
            number=number,
        )
        visions.append(vision)
    policy = PolicyLoop(
        plan,
        runner,
        clock=clock,
        view=view,
        caches=[path.cache for path in cameras],
        send=send,
        watch=watch_solve,
    )
    return Bridge(visions=tuple(visions), policy=policy, view=view)
