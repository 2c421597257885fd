"""A camera in shared memory without a renderer, whose images can go wrong."""

import os
import threading
from typing import Literal

import numpy as np

from sitl.camera.shm import FramePublisher
from sitl.clock import NS_PER_MS, Clock

SIDE = 32
"""Pixels of a side, as the policies of the catalogue take them."""
OTHER_SIDE = 48
PERIOD_S = 1 / 30
JOIN_S = 5.0
Fault = Literal[
    "none", "gone", "frozen", "black", "late", "torn", "resized", "closed", "garbage", "cut"
]
SILENT = ("gone", "closed", "garbage", "cut")
LATE_NS = 500 * NS_PER_MS


class FrameFeed:
    """Publishes noise at 30 Hz while the context lasts."""

    def __init__(self, name: str, clock: Clock) -> None:
        self._clock = clock
        self._name = name
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
        """Show something else from the next frame on; returns the moment.

        ``gone``: nothing, as after the death of the writer; ``frozen``, ``black``: the same image
        again and again; ``late``: stamps half a second old; ``torn``: frames that never become
        whole; ``resized``: another writer with larger images takes the name over; ``closed``: the
        writer ends in order; ``garbage``: a file that holds no images takes the name over; ``cut``:
        the file is cut to nothing under its readers.
        """
        self._fault = fault
        return self._clock.now_ns()

    def _run(self) -> None:
        publisher, side = FramePublisher(self._name, SIDE, SIDE), SIDE
        path, size_bytes = publisher.path, publisher.path.stat().st_size
        random = np.random.default_rng(0)
        image = np.zeros((side, side, 3), dtype=np.uint8)
        done: Fault = "none"
        while not self._stop.wait(PERIOD_S):
            fault = self._fault
            if fault != done and fault == "resized":
                before, side = publisher, OTHER_SIDE
                publisher = FramePublisher(self._name, side, side)
                before.close()
            elif fault != done and fault in ("closed", "garbage", "cut"):
                self._end_file(publisher, fault)
            done = fault
            if fault in SILENT:
                continue
            if fault == "black":
                image = np.zeros_like(image)
            elif fault != "frozen":
                image = random.integers(0, 256, (side, side, 3), dtype=np.uint8)
            stamp_ns = self._clock.now_ns() - (LATE_NS if fault == "late" else 0)
            publisher.publish(image, stamp_ns, is_whole=fault != "torn")
        if done == "cut":
            os.truncate(path, size_bytes)  # to be written once more, by ``close``
        publisher.close()
        path.unlink(missing_ok=True)

    def _end_file(self, publisher: FramePublisher, fault: Fault) -> None:
        path = publisher.path
        if fault == "closed":
            publisher.close()
        elif fault == "cut":
            os.truncate(path, 0)
        else:
            draft = path.with_name(f".{path.name}.draft")
            draft.write_bytes(b"no images " * 10)
            draft.replace(path)
