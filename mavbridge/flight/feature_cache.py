"""The cache between the two rates: one entry, the newest wins, and neither side waits."""

from mavbridge.core.records import FeatureFrame


class FeatureCache:
    """Holds the newest feature.

    Written by the vision thread, read by the action thread. A frame is immutable and replaced by
    reference, which CPython does atomically, so neither side needs a lock.
    """

    def __init__(self) -> None:
        self._frame: FeatureFrame | None = None

    def publish(self, frame: FeatureFrame) -> None:
        """Replace the held feature."""
        self._frame = frame

    def latest(self) -> FeatureFrame | None:
        """Newest feature, or None before the first."""
        return self._frame
