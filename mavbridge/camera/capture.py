"""Devices and network streams through OpenCV; blocking, so they live behind a `Grabber`."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from mavbridge.camera.grabber import Image
from mavbridge.core.clock import NS_PER_MS, NS_PER_S, Clock
from mavbridge.core.errors import CameraError
from mavbridge.core.records import ImageArray

OPEN_TIMEOUT_MS = 5000
READ_TIMEOUT_MS = 2000
FFMPEG_OPTIONS_VARIABLE = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
LOW_LATENCY_OPTIONS = "rtsp_flags;prefer_tcp|fflags;nobuffer|flags;low_delay"
"""No buffering in the demuxer, no reordering delay in the decoder. Setting options drops OpenCV's
default, which is the first of these."""
DEVICE_MODES = ((640, 480), (1280, 720), (1920, 1080))
"""What practically every camera offers; the smallest that is no smaller than the policy's image."""
MAX_DRIVER_AGE_NS = NS_PER_S


class DeviceSource:
    """A local camera: ``0`` or ``/dev/video0``."""

    def __init__(self, device: int | Path, *, image_size: int, clock: Clock) -> None:
        self._name = f"camera {device}"
        self._clock = clock
        if isinstance(device, Path):
            self._capture = cv2.VideoCapture(str(device), cv2.CAP_V4L2)
        else:
            self._capture = cv2.VideoCapture(device)
        if not self._capture.isOpened():
            raise CameraError(f"{self._name} cannot be opened; {_devices()}")
        width, height = device_mode(image_size)
        self._capture.set(cv2.CAP_PROP_FRAME_WIDTH, width)
        self._capture.set(cv2.CAP_PROP_FRAME_HEIGHT, height)

    def next_image(self) -> Image:
        """See `Source`."""
        if not self._capture.grab():
            raise CameraError(f"{self._name} has stopped delivering frames: unplugged?")
        arrived_ns = self._clock.now_ns()
        driver_ms = self._capture.get(cv2.CAP_PROP_POS_MSEC)
        return Image(
            captured_ns=exposure_ns(driver_ms, arrived_ns),
            rgb=retrieve_rgb(self._capture, self._name),
        )

    def close(self) -> None:
        """See `Source`."""
        self._capture.release()


class StreamSource:
    """A network stream that FFmpeg can read; frames are stamped on arrival."""

    def __init__(self, url: str, *, clock: Clock) -> None:
        self._name = f"stream {url}"
        self._clock = clock
        timeouts = [
            *(cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, OPEN_TIMEOUT_MS),
            *(cv2.CAP_PROP_READ_TIMEOUT_MSEC, READ_TIMEOUT_MS),
        ]
        with _ffmpeg_options(LOW_LATENCY_OPTIONS):
            self._capture = cv2.VideoCapture(url, cv2.CAP_FFMPEG, timeouts)
        if not self._capture.isOpened():
            raise CameraError(
                f"{self._name} cannot be opened within {OPEN_TIMEOUT_MS / 1000:g} s: "
                "wrong address, nobody sends, or no video in it"
            )

    def next_image(self) -> Image:
        """See `Source`."""
        if not self._capture.grab():
            raise CameraError(f"{self._name} ended, or was silent for {READ_TIMEOUT_MS / 1000:g} s")
        arrived_ns = self._clock.now_ns()
        return Image(captured_ns=arrived_ns, rgb=retrieve_rgb(self._capture, self._name))

    def close(self) -> None:
        """See `Source`."""
        self._capture.release()


@contextmanager
def _ffmpeg_options(options: str) -> Iterator[None]:
    """Options for the captures opened inside, unless the user has set some.

    OpenCV takes them from the environment alone. They must not stay there: a file that is opened
    with ``nobuffer`` loses its first frames.
    """
    if FFMPEG_OPTIONS_VARIABLE in os.environ:
        yield
        return
    os.environ[FFMPEG_OPTIONS_VARIABLE] = options
    try:
        yield
    finally:
        del os.environ[FFMPEG_OPTIONS_VARIABLE]


def retrieve_rgb(capture: cv2.VideoCapture, name: str) -> ImageArray:
    """The grabbed frame as [H, W, 3] RGB.

    Raises:
        CameraError: it cannot be decoded.
    """
    decoded, bgr = capture.retrieve()
    if not decoded:
        raise CameraError(f"{name}: a frame cannot be decoded")
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def exposure_ns(driver_ms: float, arrived_ns: int) -> int:
    """The driver's stamp if it can be one, else the arrival.

    Video4Linux stamps buffers on CLOCK_MONOTONIC, which OpenCV hands on as CAP_PROP_POS_MSEC
    (modules/videoio/src/cap_v4l.cpp); other systems put other things, or nothing, there.
    """
    stamp_ns = round(driver_ms * NS_PER_MS)
    plausible = 0 <= arrived_ns - stamp_ns <= MAX_DRIVER_AGE_NS
    return stamp_ns if plausible else arrived_ns


def device_mode(image_size: int) -> tuple[int, int]:
    """Width and height to ask a camera for, so that its short side covers ``image_size``."""
    for width, height in DEVICE_MODES:
        if height >= image_size:
            return width, height
    return DEVICE_MODES[-1]


def _devices() -> str:
    names = sorted(str(path) for path in Path("/dev").glob("video*"))
    if not names:
        return "no /dev/video* exists here"
    return f"present: {', '.join(names)} (in use elsewhere, or no right to open it: group video?)"
