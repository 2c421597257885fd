"""Notices when this computer stood still, so that a late stick is not put down to the bridge."""

import threading

from sitl.clock import NS_PER_MS, Clock

PERIOD_S = 0.005
JOIN_S = 5.0


class StallWatch:
    """A thread that wakes every 5 ms while the context lasts, and keeps its worst lateness."""

    def __init__(self) -> None:
        self.longest_ms = 0.0
        self._clock = Clock()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="stall-watch")

    def __enter__(self) -> "StallWatch":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(JOIN_S)

    def _run(self) -> None:
        last_ns = self._clock.now_ns()
        while not self._stop.wait(PERIOD_S):
            now_ns = self._clock.now_ns()
            late_ms = (now_ns - last_ns) / NS_PER_MS - PERIOD_S * 1e3
            self.longest_ms = max(self.longest_ms, late_ms)
            last_ns = now_ns
