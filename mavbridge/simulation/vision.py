"""The vision loop as events: it runs when a frame arrives, and publishes at its stamps."""

from collections import deque
from collections.abc import Callable, Iterator

import numpy as np

from mavbridge.core.ports import TickSink
from mavbridge.core.records import Event, FeatureFrame, FloatArray, ImageArray, VisionTick
from mavbridge.flight.feature_cache import FeatureCache
from mavbridge.flight.vision_loop import VisionLoop
from mavbridge.simulation.clock import AheadClock, SteppedClock
from mavbridge.simulation.world import SimulatedCamera

_IMAGES_KEPT = 4
"""One in the cache and one on its way there, doubled for safety."""


class DelayedFeatureCache(FeatureCache):
    """Publishes each feature at its ``ready_ns``."""

    def __init__(self, clock: SteppedClock) -> None:
        super().__init__()
        self._clock = clock

    def publish(self, frame: FeatureFrame) -> None:
        """Schedule the replacement of the cached feature."""
        publish_now = super().publish
        self._clock.schedule(frame.ready_ns, lambda: publish_now(frame))


class DelayedSink:
    """Passes vision ticks on when their features are ready, so that events come in time order."""

    def __init__(self, clock: SteppedClock, sink: TickSink) -> None:
        self._clock = clock
        self._sink = sink

    def emit(self, event: Event) -> None:
        """Schedule a vision tick."""
        if isinstance(event, VisionTick):
            self._clock.schedule(event.ready_ns, lambda: self._sink.emit(event))


class DelayedEncoder:
    """Takes the time of an encoding at once, and encodes only the images that an action needs.

    The vision loop gets an empty array as a placeholder, which ``resolve`` turns into the feature.
    """

    def __init__(
        self,
        encode: Callable[[ImageArray], FloatArray],
        clock: AheadClock,
        delays_ns: Iterator[int],
    ) -> None:
        self._encode = encode
        self._clock = clock
        self._delays_ns = delays_ns
        self._images: deque[tuple[FloatArray, ImageArray]] = deque(maxlen=_IMAGES_KEPT)
        self._encoded: tuple[FloatArray, FloatArray] | None = None

    def encode(self, rgb: ImageArray) -> FloatArray:
        """Placeholder of the feature of an [H, W, 3] image, [1, 0]."""
        placeholder = np.empty((1, 0), np.float32)
        self._images.append((placeholder, rgb))
        self._clock.ahead_ns += next(self._delays_ns)
        return placeholder

    def resolve(self, placeholder: FloatArray) -> FloatArray:
        """Feature behind a placeholder, [1, feature_dim] and read-only."""
        if self._encoded is None or self._encoded[0] is not placeholder:
            rgb = next(image for key, image in self._images if key is placeholder)
            feature = self._encode(rgb)
            feature.setflags(write=False)
            self._encoded = (placeholder, feature)
        return self._encoded[1]


class VisionStepper:
    """Runs a step of the vision loop whenever the loop is idle and a frame has arrived."""

    def __init__(
        self, world: SteppedClock, clock: AheadClock, camera: SimulatedCamera, loop: VisionLoop
    ) -> None:
        self._world = world
        self._clock = clock
        self._camera = camera
        self._loop = loop
        self._is_busy = False
        camera.arrival_watchers.append(self._run)

    def _run(self) -> None:
        while self._camera.has_frame and not self._is_busy:
            self._loop.step()
            busy_ns, self._clock.ahead_ns = self._clock.ahead_ns, 0
            if busy_ns:
                self._is_busy = True
                self._world.schedule(self._world.now_ns() + busy_ns, self._end)

    def _end(self) -> None:
        self._is_busy = False
        self._run()
