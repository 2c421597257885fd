"""A camera in shared memory without a renderer, whose images can go wrong."""

import threading
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sitl.camera.shm import FramePublisher
from sitl.clock import NS_PER_MS, Clock

SIDE = 32
"""Pixels of a side, as the policies of the catalogue take them."""
PERIOD_S = 1 / 30
JOIN_S = 5.0
Fault = Literal["none", "gone", "frozen", "black", "late"]
LATE_NS = 500 * NS_PER_MS


class FrameFeed:
    """Publishes noise at 30 Hz while the context lasts."""

    def __init__(self, name: str, clock: Clock) -> None:
        self._name = name
        self._clock = clock
        self._fault: Fault = "none"
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="frame-feed")

    def __enter__(self) -> "FrameFeed":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(JOIN_S)

    def show(self, fault: Fault) -> int:
        """From the next frame on: none at all, the last or a black one again, or old ones.

        Returns the moment.
        """
        self._fault = fault
        return self._clock.now_ns()

    def _run(self) -> None:
        publisher = FramePublisher(self._name, SIDE, SIDE)
        random = np.random.default_rng(0)
        image = black = np.zeros((SIDE, SIDE, 3), dtype=np.uint8)
        while not self._stop.wait(PERIOD_S):
            if self._fault == "gone":
                continue
            if self._fault != "frozen":
                image = random.integers(0, 256, (SIDE, SIDE, 3), dtype=np.uint8)
            shown: NDArray[np.uint8] = black if self._fault == "black" else image
            age_ns = LATE_NS if self._fault == "late" else 0
            publisher.publish(shown, self._clock.now_ns() - age_ns)
        publisher.close()
