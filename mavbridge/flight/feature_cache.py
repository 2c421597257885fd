"""Cache between the two rates, one per camera. The newest feature wins; neither side waits."""

import threading
from collections import deque

from mavbridge.core.reasons import Reason
from mavbridge.core.records import FeatureFrame

MAX_PAST = 1024
"""Past features kept; beyond this the oldest are dropped."""


class FeatureCache:
    """Newest feature, and past ones for policies that take several observations.

    Written by the camera's thread, read by the policy's. A feature is immutable and replaced by
    reference, which CPython does atomically; only the past features need a lock.
    """

    def __init__(self, *, span_ns: int = 0) -> None:
        """Create an empty cache. ``span_ns``: how far before the newest exposure features are kept;
        0: none."""
        self._frame: FeatureFrame | None = None
        self.refusal: Reason | None = None
        """Why the policy refused the images since the newest feature; None: it did not."""
        self._span_ns = span_ns
        self._lock = threading.Lock()
        self._past: deque[FeatureFrame] = deque(maxlen=MAX_PAST)
        """Features without a fault, by exposure, oldest first."""

    def publish(self, frame: FeatureFrame) -> None:
        """Publish a new feature."""
        self._frame, self.refusal = frame, None
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
        """Return the newest feature; None before the first."""
        return self._frame

    def nearest(self, to: FeatureFrame, *, before_ns: int) -> FeatureFrame:
        """Return the feature exposed nearest to ``before_ns`` before ``to``; ``to`` itself if none
        was kept."""
        at_ns = to.captured_ns - before_ns
        with self._lock:
            past = (*self._past, to)
        return min(past, key=lambda frame: abs(frame.captured_ns - at_ns))
