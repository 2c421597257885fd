import threading
from collections.abc import Sequence

import pytest

from helpers.factories import make_tick, make_vision_tick
from mavbridge.core.errors import PeerError
from mavbridge.core.observers import ObserverThread
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


def observing(consumer: Recorder, **sizes: int) -> ObserverThread:
    return ObserverThread("viewer", consumer, **sizes)


def test_every_event_reaches_the_consumer_in_order_on_the_named_thread() -> None:
    consumer = Recorder()
    observer = observing(consumer, capacity=1000)
    ticks = [make_tick(index) for index in range(1000)]  # more than a batch
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


def test_images_drop_before_ticks_and_the_newest_drops() -> None:
    consumer = Recorder(held=True)
    observer = observing(consumer, capacity=50, image_capacity=2)
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
    observer = observing(consumer, capacity=10)
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
    observer = observing(Recorder(error=ZeroDivisionError("oops")), capacity=10)
    observer.emit(make_tick(0))
    observer.close(DEADLINE_S)
    observer.emit(make_tick(1))
    observer.emit(make_vision_tick())
    assert observer.failure == "bug: ZeroDivisionError('oops')"
    assert observer.dropped == 3, "events after the end count"


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
@pytest.mark.parametrize(
    ("error", "failure"),
    [(OSError("disk full"), "disk full"), (ValueError("oops"), "bug: ValueError('oops')")],
)
def test_an_error_while_finishing_is_reported(
    error: Exception, failure: str, caplog: pytest.LogCaptureFixture
) -> None:
    class FailsToFinish(Recorder):
        def close(self) -> None:
            raise error

    observer = observing(FailsToFinish(), capacity=10)
    observer.close(DEADLINE_S)
    assert observer.failure == failure
    assert [record.getMessage() for record in caplog.records] == [f"viewer stopped: {failure}"]


def test_close_gives_up_on_a_consumer_that_hangs() -> None:
    consumer = Recorder(held=True)
    observer = observing(consumer, capacity=10)
    observer.emit(make_tick(0))
    assert consumer.busy.wait(DEADLINE_S)
    observer.emit(make_tick(1))
    observer.close(0.0)
    assert observer.failure == "did not finish within 0 s"
    assert observer.dropped == 2
    consumer.go_on.set()
    assert consumer.closed.wait(DEADLINE_S)  # it stops after the batch that it was in
    assert [e.index for e in consumer.events if isinstance(e, Tick)] == [0]
