"""Slow path: encode the newest frame into the feature cache, in its own thread."""

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from mavbridge.camera.image_watch import ImageWatch
from mavbridge.core.clock import NS_PER_MS, Clock, period_ns
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.records import (
    Camera,
    CameraImage,
    FeatureFrame,
    FloatArray,
    TickSink,
    VisionTick,
)
from mavbridge.flight.feature_cache import FeatureCache
from mavbridge.flight.plan import FlightPlan
from mavbridge.flight.telemetry_cache import TelemetryCache
from policy.errors import NoChunkError
from policy.files import last_line

READ_TIMEOUT_NS = 100 * NS_PER_MS
"""Longest wait for a frame between two checks of the stop flag."""
MAX_AHEAD_NS = 20 * NS_PER_MS
"""Tolerance for exposure stamps in the future, which would hide that much of the image's age."""


@dataclass(slots=True, kw_only=True)
class VisionLoop:
    """Encodes frames as they arrive, at most at the visual rate, and publishes the features.

    The camera drives the loop, not a grid. Frames that arrive faster than the visual rate are
    skipped; a quarter of a period is tolerated for camera jitter.
    """

    camera: Camera
    """Read by this loop alone."""
    encode: Callable[[CameraImage, int], FloatArray]
    """Image of a camera to its feature."""
    cache: FeatureCache
    """Gets every feature, with the fault of its image, and every refusal of the policy."""
    sink: TickSink
    """Gets a tick for every encoded or refused image."""
    clock: Clock
    """Time of the start and end of the encoding."""
    period_ns: int
    """Shortest time between two encoded frames."""
    encoder_lock: threading.Lock
    """Held while encoding; loops that share a policy share it, because no policy has to be ready
    for two threads."""
    image_watch: ImageWatch | None = None
    """Judges each encoded frame; None where the policy looks at no image, or the renderer draws
    none."""
    is_airborne: Callable[[], bool] = lambda: False
    """Whether the vehicle is known to be in the air; a frozen image is a fault only then. Called
    from this loop's thread."""
    number: int = 0
    """Place of the camera in the contract."""
    alive_ns: int = field(init=False)
    """End of the last step; read by another thread."""
    encoding_since_ns: int | None = field(default=None, init=False)
    """Start of the encoding in progress; None while waiting for the lock. Read by another
    thread."""
    _used_ns: int | None = field(default=None, init=False)
    """Slot of the last used frame."""
    _frames: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        self.alive_ns = self.clock.now_ns()

    def run(self, stop: threading.Event) -> None:
        """Encode until ``stop`` is set; raise CameraError if the camera has died."""
        while not stop.is_set():
            self.step()
            self.alive_ns = self.clock.now_ns()

    def step(self) -> None:
        """Wait up to ``READ_TIMEOUT_NS`` for one frame; encode and publish it.

        An image for which the policy raises NoChunkError is shown and recorded, but has no feature.
        Raise CameraError as ``run``.
        """
        frame = self.camera.read(READ_TIMEOUT_NS)
        started_ns = self.clock.now_ns()
        if frame is None:
            return
        captured_ns = min(frame.captured_ns, started_ns)
        if not self._is_due(captured_ns):
            return
        fault: Reason | None = None
        if self.image_watch is not None:
            is_airborne = self.is_airborne()
            fault = self.image_watch.check(frame.rgb, captured_ns, is_airborne=is_airborne)
        ahead_ns = frame.captured_ns - started_ns
        if ahead_ns > MAX_AHEAD_NS:
            ahead_ms, limit_ms = ahead_ns / NS_PER_MS, MAX_AHEAD_NS / NS_PER_MS
            fault = because(Code.IMAGE_AHEAD, ahead_ms=ahead_ms, limit_ms=limit_ms)
        value: FloatArray | None = None
        with self.encoder_lock:
            self.encoding_since_ns = self.clock.now_ns()
            try:
                value = self.encode(frame.rgb, self.number)
            except NoChunkError as error:  # the last feature ages, up to its limit
                self.cache.refusal = fault = because(Code.POLICY_REFUSED, said=last_line(error))
            finally:
                self.encoding_since_ns = None
        ready_ns = self.clock.now_ns()
        if value is not None:
            value.setflags(write=False)
            feature = FeatureFrame(
                frame_id=frame.frame_id,
                captured_ns=captured_ns,
                ready_ns=ready_ns,
                value=value,
                fault=fault,
            )
            self.cache.publish(feature)
        self.sink.emit(
            VisionTick(
                serial=self._frames,
                frame_id=frame.frame_id,
                captured_ns=captured_ns,
                started_ns=started_ns,
                ready_ns=ready_ns,
                dropped_frames=self.camera.dropped_frames,
                rgb=frame.rgb,
                camera=self.number,
                feature=value,
                fault=fault,
            )
        )
        self._frames += 1

    def _is_due(self, captured_ns: int) -> bool:
        if self._used_ns is None:
            self._used_ns = captured_ns
            return True
        due_ns = self._used_ns + self.period_ns
        if captured_ns < due_ns - self.period_ns // 4:
            return False
        # Keep the grid through jitter; after a gap start a new one.
        self._used_ns = max(due_ns, captured_ns - self.period_ns // 2)
        return True


def vision_loops(
    plan: FlightPlan,
    view: TelemetryCache,
    *,
    encode: Callable[[CameraImage, int], FloatArray],
    cameras: Sequence[Camera],
    caches: Sequence[FeatureCache],
    clocks: Sequence[Clock],
    sinks: Sequence[TickSink],
    watches_images: bool,
) -> tuple[VisionLoop, ...]:
    """Return the loop of each camera of a policy, in the contract's order.

    ``encode`` is ``PolicyRunner.encode``, in turns of the loops.
    ``watches_images``: a frozen or a black image is a fault; False where nobody looks at it.
    """
    config, encoder_lock = plan.config.camera, threading.Lock()
    parts = zip(cameras, caches, clocks, sinks, plan.image_rates_hz, strict=True)
    return tuple(
        VisionLoop(
            camera=camera,
            encode=encode,
            cache=cache,
            sink=sink,
            clock=clock,
            period_ns=period_ns(rate_hz),
            encoder_lock=encoder_lock,
            image_watch=ImageWatch(
                max_frozen_s=config.max_frozen_image, max_black_s=config.max_black_image
            )
            if watches_images
            else None,
            is_airborne=lambda: view.is_airborne,
            number=number,
        )
        for number, (camera, cache, clock, sink, rate_hz) in enumerate(parts)
    )
