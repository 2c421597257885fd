"""A camera in shared memory without a renderer, which can be paused."""

import threading
import time

import numpy as np

from sitl.camera.shm import FramePublisher

SIDE = 32
PERIOD_S = 1 / 30


class FrameFeed:
    """Publishes noise at 30 Hz while the context lasts."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._stop = threading.Event()
        self._may_run = threading.Event()
        self._may_run.set()
        self._thread = threading.Thread(target=self._run, name="frame-feed")

    def __enter__(self) -> "FrameFeed":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._may_run.set()
        self._thread.join(5)

    def pause(self) -> int:
        """No more frames, as if the writer had been killed; returns the moment."""
        self._may_run.clear()
        return time.monotonic_ns()

    def resume(self) -> None:
        self._may_run.set()

    def _run(self) -> None:
        publisher = FramePublisher(self._name, SIDE, SIDE)
        random = np.random.default_rng(0)
        while not self._stop.wait(PERIOD_S):
            self._may_run.wait()
            image = random.integers(0, 256, (SIDE, SIDE, 3), dtype=np.uint8)
            publisher.publish(image, time.monotonic_ns())
        publisher.close()
