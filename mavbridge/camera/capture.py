"""Devices and network streams through OpenCV. Their reads block, so they run behind a `Grabber`."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from mavbridge.camera.grabber import Image
from mavbridge.camera.pipe_frames import DamageCount
from mavbridge.core.clock import NS_PER_MS, Clock
from mavbridge.core.errors import CameraError
from mavbridge.core.provenance import without_secrets
from mavbridge.core.records import CameraImage
from policy.files import library_name

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
    with _ffmpeg_options(options):
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
