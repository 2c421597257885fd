"""A recorded video as a camera."""

import math
from pathlib import Path

import cv2

from mavbridge.camera.capture import retrieve_rgb
from mavbridge.core.clock import NS_PER_MS, NS_PER_S, Clock
from mavbridge.core.errors import CameraError
from mavbridge.core.records import Frame, ImageArray

DEFAULT_FPS = 30.0
"""For files without stamps and without a rate."""


class VideoFileCamera:
    """Plays a file at its own pace on the injected clock, from the first ``read`` on.

    Frames become due at their own stamps; of several that are due, the newest is returned and the
    others count as dropped. After the last frame ``read`` raises CameraError. Decodes in ``read``:
    there is no thread.
    """

    def __init__(self, path: Path, *, clock: Clock) -> None:
        """Open the file and decode its first frame.

        Raises:
            CameraError: not a video that OpenCV can decode.
        """
        self._path = path
        self._clock = clock
        self._capture = cv2.VideoCapture(str(path))
        fps = self._capture.get(cv2.CAP_PROP_FPS)
        self._interval_ns = round(
            NS_PER_S / (fps if math.isfinite(fps) and fps > 0 else DEFAULT_FPS)
        )
        self._start_ns: int | None = None
        self._frame_count = 0
        self._dropped_frames = 0
        self._upcoming = self._decode(previous_ns=None)
        if self._upcoming is None:
            self._capture.release()
            raise CameraError(f"{path} holds no video that can be decoded")

    @property
    def dropped_frames(self) -> int:
        """Frames that became due and were followed by another before they were read."""
        return self._dropped_frames

    def read(self, timeout_ns: int) -> Frame | None:
        """See `mavbridge.core.ports.Camera`."""
        now_ns = self._clock.now_ns()
        deadline_ns = now_ns + timeout_ns
        if self._start_ns is None:
            self._start_ns = now_ns
        if self._upcoming is None:
            raise CameraError(f"{self._path}: video ended after {self._frame_count} frames")
        due_ns = self._start_ns + self._upcoming[0]
        self._clock.sleep_until_ns(min(due_ns, deadline_ns))
        if due_ns > deadline_ns:
            return None
        return self._newest_due(self._start_ns, self._clock.now_ns())

    def close(self) -> None:
        """Close the file."""
        self._capture.release()

    def _newest_due(self, start_ns: int, now_ns: int) -> Frame | None:
        newest = None
        while self._upcoming is not None and start_ns + self._upcoming[0] <= now_ns:
            self._dropped_frames += newest is not None
            self._frame_count += 1
            newest = self._upcoming
            self._upcoming = self._decode(previous_ns=newest[0])
        if newest is None:
            return None
        stamp_ns, rgb = newest
        return Frame(frame_id=self._frame_count, captured_ns=start_ns + stamp_ns, rgb=rgb)

    def _decode(self, *, previous_ns: int | None) -> tuple[int, ImageArray] | None:
        """The next frame and its time since the start of the file; None at the end.

        A stamp that does not increase, as in files that carry none, is replaced by the nominal one.
        """
        if not self._capture.grab():
            return None
        stamp_ms = self._capture.get(cv2.CAP_PROP_POS_MSEC)
        rgb = retrieve_rgb(self._capture, str(self._path))
        rgb.flags.writeable = False
        stamp_ns = round(stamp_ms * NS_PER_MS)
        if previous_ns is not None and stamp_ns <= previous_ns:
            stamp_ns = previous_ns + self._interval_ns
        return stamp_ns, rgb
