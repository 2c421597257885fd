"""Recorded video as a camera."""

import math
from pathlib import Path
from typing import NamedTuple

import cv2

from mavbridge.camera.capture import retrieve_rgb
from mavbridge.camera.grabber import wait_until_due
from mavbridge.core.clock import NS_PER_MS, NS_PER_S, Clock
from mavbridge.core.errors import CameraError
from mavbridge.core.records import CameraImage, Frame
from policy.files import library_name, why_unreadable

DEFAULT_FPS = 30.0
"""Frame rate for files with neither stamps nor a rate."""
DEPTH_FORMAT = int.from_bytes(b"Y1\0\x10", "little")
"""FFmpeg's gray16le, as in the camera.mp4 of a flight with depth images."""


class FileImage(NamedTuple):
    """Image of a file, with its time there."""

    at_ns: int
    rgb: CameraImage


class VideoFileCamera:
    """Plays a file in real time on the injected clock, from the first ``read`` on.

    Frames become due at their stamps. If several are due, the newest is returned and the others
    count as dropped. After the last frame ``read`` raises CameraError. Frames are decoded in
    ``read``; there is no thread.
    """

    def __init__(self, path: Path, *, clock: Clock) -> None:
        """Open the file. Raises CameraError if OpenCV cannot decode its first frame."""
        self._path = path
        self._clock = clock
        self._capture = cv2.VideoCapture(library_name(path))
        if self._capture.get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT) == DEPTH_FORMAT:
            self._capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)
        fps = self._capture.get(cv2.CAP_PROP_FPS)
        has_rate = math.isfinite(fps) and fps > 0
        self._interval_ns = round(NS_PER_S / (fps if has_rate else DEFAULT_FPS))
        self._start_ns: int | None = None
        self._frame_count = 0
        self.dropped_frames = 0
        self.upcoming = self._decode(previous_ns=None)
        """Next image; None at the end."""
        if self.upcoming is None:
            self._capture.release()
            raise CameraError(why_unreadable(path, ValueError("no video that can be decoded")))

    def read(self, timeout_ns: int) -> Frame | None:
        """See `mavbridge.core.records.Camera`."""
        if self._start_ns is None:
            self._start_ns = self._clock.now_ns()
        if self.upcoming is None:
            raise CameraError(f"{self._path}: video ended after {self._frame_count} frames")
        if not wait_until_due(self._clock, self._start_ns + self.upcoming.at_ns, timeout_ns):
            return None
        newest, played_ns = self.upcoming, self._clock.now_ns() - self._start_ns
        frames_before = self._frame_count
        while self.upcoming is not None and self.upcoming.at_ns <= played_ns:
            newest = self.upcoming
            self._frame_count += 1
            self.upcoming = self._decode(previous_ns=newest.at_ns)
        self.dropped_frames += self._frame_count - frames_before - 1
        due_ns = self._start_ns + newest.at_ns
        return Frame(
            frame_id=self._frame_count, captured_ns=due_ns, rgb=newest.rgb, is_stamped=True
        )

    def close(self) -> None:
        """Close the file."""
        self._capture.release()

    def _decode(self, *, previous_ns: int | None) -> FileImage | None:
        """Return the next image; None at the end.

        A stamp that does not increase, as in files without stamps, is replaced by the nominal one.
        """
        if not self._capture.grab():
            return None
        stamp_ns = round(self._capture.get(cv2.CAP_PROP_POS_MSEC) * NS_PER_MS)
        if (rgb := retrieve_rgb(self._capture)) is None:
            raise CameraError(f"{self._path}: a frame cannot be decoded")
        rgb.flags.writeable = False
        if previous_ns is not None and stamp_ns <= previous_ns:
            stamp_ns = previous_ns + self._interval_ns
        return FileImage(stamp_ns, rgb)
