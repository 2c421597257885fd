"""Devices, network streams and video files through OpenCV.

Reads of devices and streams block, so they run behind a `Grabber`.
"""

import math
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from mavbridge.camera.grabber import Image, wait_until_due
from mavbridge.camera.pipe_frames import DamageCount
from mavbridge.core.clock import NS_PER_MS, NS_PER_S, Clock
from mavbridge.core.errors import CameraError
from mavbridge.core.provenance import without_secrets
from mavbridge.core.records import CameraImage, Frame
from policy.files import library_name, why_unreadable

OPEN_TIMEOUT_MS = 5000
READ_TIMEOUT_MS = 2000
FFMPEG_OPTIONS_VARIABLE = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
FFMPEG_LOG_VARIABLE = "OPENCV_FFMPEG_LOGLEVEL"
LOW_LATENCY_OPTIONS = "rtsp_flags;prefer_tcp|fflags;nobuffer|flags;low_delay"
"""No buffering in the demuxer, no reordering delay in the decoder. Setting any option drops
OpenCV's default, which is repeated as the first one."""
SDP_OPTIONS = "|protocol_whitelist;file,udp,rtp"
"""Protocols that FFmpeg must be allowed to use for the sources in an .sdp file."""
DEVICE_MODES = ((640, 480), (1280, 720), (1920, 1080))
"""Modes of practically every camera; the smallest that covers the policy's image is used."""
_opening = threading.Lock()
"""Held while OpenCV reads its options from the environment, which all cameras share."""


@dataclass(slots=True)
class CaptureSource:
    """`ImageSource` over an open OpenCV capture; ``failure`` is the likely reason for its end."""

    capture: cv2.VideoCapture
    name: str
    failure: str
    clock: Clock
    has_driver_stamps: bool = False
    """True on a device. Video4Linux stamps buffers on CLOCK_MONOTONIC, which OpenCV returns as
    CAP_PROP_POS_MSEC (modules/videoio/src/cap_v4l.cpp); other systems return something else."""
    damage: DamageCount = field(init=False)
    """Of frames that could not be decoded: cables damage MJPEG."""

    def __post_init__(self) -> None:
        self.damage = DamageCount(self.name, "frames")

    def next_image(self) -> Image | None:
        """See `ImageSource`."""
        if not self.capture.grab():
            raise CameraError(f"{self.name} {self.failure}")
        arrived_ns, stamp_ms = self.clock.now_ns(), 0.0
        if self.has_driver_stamps:
            stamp_ms = self.capture.get(cv2.CAP_PROP_POS_MSEC)
        rgb = retrieve_rgb(self.capture)
        self.damage.note(rgb)
        return None if rgb is None else Image(arrived_ns, rgb, round(stamp_ms * NS_PER_MS))

    def close(self) -> None:
        """See `ImageSource`."""
        self.capture.release()


def open_device(device: int | Path, *, image_size: tuple[int, int], clock: Clock) -> CaptureSource:
    """Open a local camera: ``0`` or ``/dev/video0``. Raises CameraError.

    ``image_size`` is the least height and width [pixels].
    """
    is_path = isinstance(device, Path)
    capture = cv2.VideoCapture(str(device), cv2.CAP_V4L2) if is_path else cv2.VideoCapture(device)
    if not capture.isOpened():
        raise CameraError(f"camera {device} cannot be opened; {present_devices()}")
    width, height = device_mode(*image_size)
    capture.set(cv2.CAP_PROP_FRAME_WIDTH, width)
    capture.set(cv2.CAP_PROP_FRAME_HEIGHT, height)
    failure = "has stopped delivering frames: was it unplugged?"
    return CaptureSource(capture, f"camera {device}", failure, clock, has_driver_stamps=True)


def present_devices() -> str:
    """Describe the local cameras of this computer for a message."""
    found = [*Path("/dev").glob("video*"), *Path("/dev").glob("v4l/by-id/*")]
    names = ", ".join(sorted(map(str, found)))
    if not names:
        return "there is no /dev/video* on this machine"
    return f"present: {names} (in use, or no permission to open it: group video?)"


def open_stream(url: str, *, clock: Clock) -> CaptureSource:
    """Open a network stream or an .sdp file. Frames are stamped on arrival.

    Raises CameraError if no video arrives within OPEN_TIMEOUT_MS.
    """
    timeouts = [
        *(cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, OPEN_TIMEOUT_MS),
        *(cv2.CAP_PROP_READ_TIMEOUT_MSEC, READ_TIMEOUT_MS),
        *(cv2.CAP_PROP_N_THREADS, 1),  # each additional thread delays by one frame
    ]
    name, source, options = without_secrets(url), url, LOW_LATENCY_OPTIONS
    if "://" not in url:
        source, options = library_name(Path(url)), options + SDP_OPTIONS
    with _opening, _ffmpeg_options(options):
        capture = cv2.VideoCapture(source, cv2.CAP_FFMPEG, timeouts)
    if not capture.isOpened():
        raise CameraError(
            f"stream {name} cannot be opened within {OPEN_TIMEOUT_MS / 1000:g} s: check the "
            "address, that the sender is running, and that it sends video"
            + ("; H.264 over RTP is opened by its .sdp file" if url.startswith("rtp:") else "")
        )
    failure = f"ended, or was silent for {READ_TIMEOUT_MS / 1000:g} s"
    return CaptureSource(capture, f"stream {name}", failure, clock)


@contextmanager
def _ffmpeg_options(options: str) -> Iterator[None]:
    """Context manager: set FFmpeg options for captures opened inside, unless the user has set some.

    OpenCV reads them only from the environment. They must not stay there: a file opened with
    ``nobuffer`` loses its first frames. FFmpeg is also silenced: it would complain about each frame
    of a stream joined between two key frames.
    """
    wanted = {FFMPEG_OPTIONS_VARIABLE: options, FFMPEG_LOG_VARIABLE: "-8"}
    added = {name: value for name, value in wanted.items() if name not in os.environ}
    os.environ.update(added)
    try:
        yield
    finally:
        for name in added:
            del os.environ[name]


def retrieve_rgb(capture: cv2.VideoCapture) -> CameraImage | None:
    """Return the grabbed frame in RGB or as depth; None if it cannot be decoded."""
    decoded, bgr = capture.retrieve()
    if not decoded or bgr is None:  # OpenCV's own decoder of MJPEG returns True and None
        return None
    if bgr.ndim == 2:
        return np.asarray(bgr, dtype=np.uint16)
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def device_mode(height: int, width: int) -> tuple[int, int]:
    """Return the width and height to request, so that they cover ``height`` and ``width``."""
    covering = (mode for mode in DEVICE_MODES if mode[0] >= width and mode[1] >= height)
    return next(covering, DEVICE_MODES[-1])


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
        with _opening:
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
