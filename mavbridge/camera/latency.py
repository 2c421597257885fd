"""Exposure stamps for sources that stamp a frame when it arrives."""

from dataclasses import replace

from mavbridge.core.ports import Camera
from mavbridge.core.records import Frame


class LatencyCompensatedCamera:
    """Another camera, whose stamps lie earlier by its latency: exposure to arrival here."""

    def __init__(self, camera: Camera, *, latency_ns: int) -> None:
        """Wrap an open camera; closing this one closes it."""
        self._camera = camera
        self._latency_ns = latency_ns

    @property
    def dropped_frames(self) -> int:
        """See `mavbridge.core.ports.Camera`."""
        return self._camera.dropped_frames

    def read(self, timeout_ns: int) -> Frame | None:
        """See `mavbridge.core.ports.Camera`."""
        frame = self._camera.read(timeout_ns)
        if frame is None:
            return None
        return replace(frame, captured_ns=frame.captured_ns - self._latency_ns)

    def close(self) -> None:
        """Close the wrapped camera."""
        self._camera.close()
