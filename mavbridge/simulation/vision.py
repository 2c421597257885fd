"""The vision loop as events: it runs when a frame is there, its results exist when it says so."""

from collections import deque
from collections.abc import Callable, Iterator

import numpy as np

from mavbridge.core.ports import TickSink
from mavbridge.core.records import Event, FeatureFrame, FloatArray, ImageArray, VisionTick
from mavbridge.flight.feature_cache import FeatureCache
from mavbridge.flight.vision_loop import VisionLoop
from mavbridge.simulation.clock import AheadClock, SteppedClock
from mavbridge.simulation.world import LockstepCamera

_IMAGES_KEPT = 4
"""One in the cache, one on its way there; twice that."""


class LateFeatureCache(FeatureCache):
    """A feature is published at its own ``ready_ns``."""

    def __init__(self, clock: SteppedClock) -> None:
        super().__init__()
        self._clock = clock

    def publish(self, frame: FeatureFrame) -> None:
        """Plan to replace the held feature."""
        publish_now = super().publish
        self._clock.schedule(frame.ready_ns, lambda: publish_now(frame))


class LateSink:
    """Sees a vision tick when its feature is ready, so that all events come in order of time."""

    def __init__(self, clock: SteppedClock, sink: TickSink) -> None:
        self._clock = clock
        self._sink = sink

    def emit(self, event: Event) -> None:
        """Plan to pass the event on."""
        if isinstance(event, VisionTick):
            self._clock.schedule(event.ready_ns, lambda: self._sink.emit(event))


class LateEncoder:
    """Encodes an image when a chunk is first asked for it: what nobody looks at costs nothing.

    Until then an empty array stands for the feature; the loops never look into one.
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
        """Stand-in for the feature; the time is taken now."""
        stand_in = np.empty((1, 0), np.float32)
        self._images.append((stand_in, rgb))
        self._clock.ahead_ns += next(self._delays_ns)
        return stand_in

    def resolve(self, stand_in: FloatArray) -> FloatArray:
        """The feature."""
        if self._encoded is None or self._encoded[0] is not stand_in:
            rgb = next(rgb for held, rgb in self._images if held is stand_in)
            feature = self._encode(rgb)
            feature.setflags(write=False)
            self._encoded = (stand_in, feature)
        return self._encoded[1]


class VisionProcess:
    """Runs the vision loop whenever it is free and a frame is there."""

    def __init__(
        self, world: SteppedClock, clock: AheadClock, camera: LockstepCamera, loop: VisionLoop
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
