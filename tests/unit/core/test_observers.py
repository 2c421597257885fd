import threading
from collections.abc import Sequence

import pytest

from helpers.factories import make_tick, make_vision_tick
from mavbridge.core.errors import PeerError
from mavbridge.core.observers import BoundedQueue, FanOut, ObserverThread
from mavbridge.core.records import Event, Tick, VisionTick

DEADLINE_S = 10.0


class Recorder:
    """Keeps what it is given; can be held up or made to fail."""

    def __init__(self, *, error: Exception | None = None, held: bool = False) -> None:
        self.error = error
        self.events: list[Event] = []
        self.consumed_on: set[str] = set()
        self.busy = threading.Event()
        self.go_on = threading.Event()
        self.closed = threading.Event()
        if not held:
            self.go_on.set()

    def consume(self, batch: Sequence[Event]) -> None:
        self.busy.set()
        assert self.go_on.wait(DEADLINE_S)
        self.consumed_on.add(threading.current_thread().name)
        if self.error is not None:
            raise self.error
        self.events += batch

    def close(self) -> None:
        self.closed.set()


def test_every_event_reaches_the_consumer_in_order_on_the_named_thread() -> None:
    consumer = Recorder()
    observer = ObserverThread("viewer", consumer, capacity=100)
    ticks = [make_tick(index) for index in range(100)]
    frames = [make_vision_tick(number) for number in range(1, 5)]
    for event in (*ticks, *frames):
        observer.emit(event)
    observer.close(DEADLINE_S)
    assert [event for event in consumer.events if isinstance(event, Tick)] == ticks
    seen_ids = [event.frame_id for event in consumer.events if isinstance(event, VisionTick)]
    assert seen_ids == [1, 2, 3, 4]
    assert consumer.consumed_on == {"viewer"}
    assert consumer.closed.is_set()
    assert observer.dropped == 0
    assert observer.failure is None


def test_a_backlog_larger_than_a_batch_is_worked_off_at_close() -> None:
    consumer = Recorder()
    observer = ObserverThread("viewer", consumer, capacity=1000)
    for index in range(1000):
        observer.emit(make_tick(index))
    observer.close(DEADLINE_S)
    assert len(consumer.events) == 1000


def test_images_drop_before_ticks_and_the_newest_drops() -> None:
    consumer = Recorder(held=True)
    observer = ObserverThread("viewer", consumer, capacity=50, image_capacity=2)
    observer.emit(make_tick(0))
    assert consumer.busy.wait(DEADLINE_S)  # tick 0 is in the consumer's hands: queues are empty
    for index in range(1, 51):
        observer.emit(make_tick(index))
    for number in range(1, 6):
        observer.emit(make_vision_tick(number))
    assert observer.dropped == 3
    observer.emit(make_tick(51))
    assert observer.dropped == 4
    consumer.go_on.set()
    observer.close(DEADLINE_S)
    assert [e.index for e in consumer.events if isinstance(e, Tick)] == list(range(51))
    assert [e.frame_id for e in consumer.events if isinstance(e, VisionTick)] == [1, 2]
    assert observer.dropped == 4


@pytest.mark.parametrize("error", [PeerError("the viewer is gone"), OSError("the viewer is gone")])
def test_an_expected_error_stops_the_observer_once_and_counts_the_rest(
    error: Exception, caplog: pytest.LogCaptureFixture
) -> None:
    consumer = Recorder(error=error, held=True)
    observer = ObserverThread("viewer", consumer, capacity=10)
    observer.emit(make_tick(0))
    assert consumer.busy.wait(DEADLINE_S)
    observer.emit(make_tick(1))  # queued while the consumer is failing on tick 0
    consumer.go_on.set()
    assert consumer.closed.wait(DEADLINE_S)
    observer.emit(make_tick(2))
    observer.close(DEADLINE_S)
    assert observer.failure == "the viewer is gone"
    assert observer.dropped == 3
    assert [record.getMessage() for record in caplog.records] == [
        "viewer stopped: the viewer is gone; the flight goes on without it"
    ]


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_bug_in_the_consumer_shows_its_traceback_and_does_not_reach_the_loop() -> None:
    observer = ObserverThread("viewer", Recorder(error=ZeroDivisionError("oops")), capacity=10)
    observer.emit(make_tick(0))
    observer.close(DEADLINE_S)
    observer.emit(make_tick(1))
    assert observer.failure == "bug: ZeroDivisionError('oops')"
    assert observer.dropped == 2


def test_an_error_while_finishing_is_reported() -> None:
    class FailsToFinish(Recorder):
        def close(self) -> None:
            raise OSError("disk full")

    observer = ObserverThread("viewer", FailsToFinish(), capacity=10)
    observer.close(DEADLINE_S)
    assert observer.failure == "disk full"


def test_close_gives_up_on_a_consumer_that_hangs() -> None:
    consumer = Recorder(held=True)
    observer = ObserverThread("viewer", consumer, capacity=10)
    observer.emit(make_tick(0))
    assert consumer.busy.wait(DEADLINE_S)
    observer.emit(make_tick(1))
    observer.close(0.0)
    assert observer.failure == "did not finish within 0 s"
    assert observer.dropped == 2
    consumer.go_on.set()
    assert consumer.closed.wait(DEADLINE_S)  # it stops after the batch that it was in
    assert [e.index for e in consumer.events if isinstance(e, Tick)] == [0]


def test_events_after_close_are_counted() -> None:
    observer = ObserverThread("viewer", Recorder(), capacity=10)
    observer.close(DEADLINE_S)
    observer.emit(make_tick())
    observer.emit(make_vision_tick())
    assert observer.dropped == 2


def test_a_full_queue_drops_and_counts() -> None:
    queue: BoundedQueue[int] = BoundedQueue(3)
    for item in range(5):
        queue.put(item)
    assert queue.dropped == 2
    assert queue.take(2) == [0, 1]
    assert queue.take() == [2]
    assert queue.take() == []


@pytest.mark.parametrize("capacities", [(0, 1), (1, 0), (-3, 1)])
def test_a_queue_without_room_is_refused(capacities: tuple[int, int]) -> None:
    capacity, image_capacity = capacities
    with pytest.raises(ValueError, match="capacity must be at least 1"):
        ObserverThread("viewer", Recorder(), capacity=capacity, image_capacity=image_capacity)


def test_fan_out_gives_each_event_to_every_sink_in_order() -> None:
    calls: list[tuple[str, Event]] = []

    class Sink:
        def __init__(self, name: str) -> None:
            self.name = name

        def emit(self, event: Event) -> None:
            calls.append((self.name, event))

    tick = make_tick()
    FanOut([Sink("a"), Sink("b")]).emit(tick)
    assert calls == [("a", tick), ("b", tick)]
