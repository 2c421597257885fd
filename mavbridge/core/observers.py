"""Observers behind bounded queues: they drop events rather than delay a loop."""

import logging
import threading
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Generic, Protocol, TypeVar

from mavbridge.core.errors import MavbridgeError
from mavbridge.core.records import Event, Observed, Solve, Tick, TickSink

BATCH_PERIOD_S = 0.1
"""Time between batches. The queue is polled: waking a thread from ``emit`` would cost the loop a
system call and contention for the interpreter lock."""
BATCH_EVENTS = 256
"""Most events of a kind per batch, so that a backlog is handled in short stretches."""

_log = logging.getLogger(__name__)
_Item = TypeVar("_Item")


class Consumer(Protocol):
    """Work of an observer, called by the observer's thread only."""

    def consume(self, batch: Sequence[Observed]) -> None:
        """Handle events: all ticks in order, then all solves, then all vision ticks in order.

        Raises:
            MavbridgeError, OSError: the consumer cannot continue; it gets no further batch.
        """

    def close(self) -> None:
        """Finish. Called once, after the last batch, also if ``consume`` has raised."""


class BoundedQueue(Generic[_Item]):
    """Lock-free queue of one producer and one consumer. Neither ever waits."""

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._items: deque[_Item] = deque()
        self.dropped = 0

    def __len__(self) -> int:
        return len(self._items)

    def put(self, item: _Item, /) -> None:
        """Add an item, or drop and count it if the queue is full."""
        if len(self._items) < self._capacity:
            self._items.append(item)
        else:
            self.dropped += 1

    def take(self, limit: int | None = None) -> list[_Item]:
        """Remove and return the oldest items, at most ``limit``."""
        waiting = len(self._items)
        count = waiting if limit is None else min(waiting, limit)
        return [self._items.popleft() for _ in range(count)]


class ObserverThread:
    """A ``TickSink`` that passes events in batches to a consumer on its own thread.

    Ticks and vision ticks queue separately, so images, which are large and slow to handle, drop
    first and never push a tick out. Ticks must be emitted by one thread, solves by one, and the
    vision ticks of each camera by one. The observer's thread is a daemon: a consumer that hangs
    cannot keep the process alive.
    """

    def __init__(
        self,
        name: str,
        consumer: Consumer,
        *,
        capacity: int,
        image_capacity: int = 16,
        cameras: int = 1,
    ) -> None:
        """Start the thread. The consumer belongs to it from here on.

        ``capacity``: most queued ticks, and most queued solves. ``image_capacity``: most queued
        vision ticks per camera.
        """
        self._name = name
        self._ticks: BoundedQueue[Observed] = BoundedQueue(capacity)
        self._solves: BoundedQueue[Observed] = BoundedQueue(capacity)
        self._visions: list[BoundedQueue[Observed]] = [
            BoundedQueue(image_capacity) for _ in range(cameras)
        ]
        self._closing = threading.Event()
        self._out_of_time = threading.Event()
        self._open = True
        self.failure: str | None = None
        """Why the observer stopped before it was closed, or None."""
        self._in_flight = 0
        self._thread = threading.Thread(target=self._run, args=(consumer,), name=name, daemon=True)
        self._thread.start()

    def emit(self, event: Observed) -> None:
        """Queue the event, or drop and count it. Never blocks, never raises."""
        queue = self._queue_of(event)
        if self._open:
            queue.put(event)
        else:
            queue.dropped += 1

    def _queue_of(self, event: Observed) -> BoundedQueue[Observed]:
        if isinstance(event, Tick):
            return self._ticks
        return self._solves if isinstance(event, Solve) else self._visions[event.camera]

    @property
    def dropped(self) -> int:
        """Number of events that the consumer never got, or failed on."""
        queues = (self._ticks, self._solves, *self._visions)
        dropped = sum(queue.dropped for queue in queues)
        if self._thread.is_alive() and not self._out_of_time.is_set():
            return dropped
        return dropped + sum(map(len, queues)) + self._in_flight

    def close(self, timeout_s: float) -> bool:
        """Let the consumer empty the queue and finish, for at most ``timeout_s``; return whether
        its thread has ended."""
        self._open = False
        self._closing.set()
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            self._out_of_time.set()
            self._fail(f"did not finish within {timeout_s:g} s")
        return not self._out_of_time.is_set()

    def _run(self, consumer: Consumer) -> None:
        try:
            with self._failing():
                while not self._out_of_time.is_set():
                    is_last_round = self._closing.wait(BATCH_PERIOD_S)
                    batch = self._ticks.take(BATCH_EVENTS)
                    for queue in (self._solves, *self._visions):
                        batch += queue.take(BATCH_EVENTS)
                    if batch:
                        self._in_flight = len(batch)
                        consumer.consume(batch)
                        self._in_flight = 0
                    elif is_last_round:
                        return
        finally:
            self._open = False
            with self._failing():
                consumer.close()

    @contextmanager
    def _failing(self) -> Iterator[None]:
        """Context manager: keep the reason of an error; raise a bug again, for its traceback."""
        try:
            yield
        except (MavbridgeError, OSError) as error:
            self._fail(str(error))
        except Exception as bug:
            self._fail(f"bug: {bug!r}")
            raise

    def _fail(self, reason: str) -> None:
        if self.failure is None:
            self.failure = reason
            after = "" if self._closing.is_set() else "; the flight goes on without it"
            _log.warning("%s stopped: %s%s", self._name, reason, after)


class FanOut:
    """A ``TickSink`` that passes every event to several others."""

    def __init__(self, sinks: Iterable[TickSink]) -> None:
        self._sinks = tuple(sinks)

    def emit(self, event: Event) -> None:
        """Pass the event to every sink, in order."""
        for sink in self._sinks:
            sink.emit(event)
