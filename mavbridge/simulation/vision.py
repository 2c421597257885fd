"""The vision loop as events: it runs when a frame arrives, and publishes at its stamps."""

from mavbridge.core.ports import TickSink
from mavbridge.core.records import Event, FeatureFrame, VisionTick
from mavbridge.flight.feature_cache import FeatureCache
from mavbridge.flight.vision_loop import VisionLoop
from mavbridge.simulation.clock import AheadClock, SteppedClock
from mavbridge.simulation.world import SimulatedCamera


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
