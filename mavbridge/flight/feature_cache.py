"""The cache between the two rates, one for each camera: the newest wins, and neither side waits."""

import threading
from collections import deque

from mavbridge.core.records import FeatureFrame

MAX_PAST = 1024
"""Most past features that are kept: of a longer span of time the oldest are forgotten."""


class FeatureCache:
    """Holds the newest feature, and past ones where the policy takes several observations.

    Written by the thread of the camera, read by the action thread. A frame is immutable and
    replaced by reference, which CPython does atomically; only the past ones need a lock.
    """

    def __init__(self, *, span_ns: int = 0) -> None:
        """``span_ns``: time before the newest exposure for which features are kept; 0 = none."""
        self._frame: FeatureFrame | None = None
        self._span_ns = span_ns
        self._lock = threading.Lock()
        self._past: deque[FeatureFrame] = deque(maxlen=MAX_PAST)
        """By exposure, oldest first; none of them has a fault."""

    def publish(self, frame: FeatureFrame) -> None:
        """Replace the held feature."""
        self._frame = frame
        if not self._span_ns or frame.fault is not None:
            return
        with self._lock:
            self._past.append(frame)
            # One from before the span stays: the nearest to its beginning may be that one.
            while len(self._past) > 1:
                if self._past[1].captured_ns > frame.captured_ns - self._span_ns:
                    break
                self._past.popleft()

    def latest(self) -> FeatureFrame | None:
        """Newest feature, or None before the first."""
        return self._frame

    def nearest(self, to: FeatureFrame, *, before_ns: int) -> FeatureFrame:
        """The feature whose exposure is nearest to ``before_ns`` before that of ``to``.

        ``to`` itself where none was kept.
        """
        at_ns = to.captured_ns - before_ns
        with self._lock:
            past = (*self._past, to)
        return min(past, key=lambda frame: abs(frame.captured_ns - at_ns))
