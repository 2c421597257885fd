"""Senders of camera images on loopback: chunked JPEG over UDP, and H.264 over RTP."""

import socket
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from struct import Struct
from types import TracebackType
from typing import Any

import av
import cv2
import numpy as np

from mavbridge.camera.grabber import Image, ImageSource
from mavbridge.core.clock import NS_PER_S, MonotonicClock
from mavbridge.core.stopping import Worker

HEADER = Struct("<IHHIIQ")
"""From the description of the format, independent of the tested code."""
SIDE = 64
HZ = 30


def chunks(frame_id: int, data: bytes, *, part: int = 1400, stamp_ns: int = 0) -> list[bytes]:
    parts = [data[at : at + part] for at in range(0, len(data), part)]
    return [
        HEADER.pack(frame_id % (1 << 32), place, len(parts), len(data), len(each), stamp_ns) + each
        for place, each in enumerate(parts)
    ]


def encoded(image: np.ndarray, suffix: str = ".jpg") -> bytes:
    """Encode an RGB image as JPEG or PNG, or a depth image as PNG."""
    bgr = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    _, data = cv2.imencode(suffix, bgr)
    return data.tobytes()


def scene(number: int) -> np.ndarray:
    """Return an RGB image with a pattern that differs for each number."""
    rows, columns = np.mgrid[:SIDE, :SIDE]
    planes = [rows * 3 + number * 16, columns * 3, (rows + columns) * 2 - number * 16]
    return np.stack([plane % 256 for plane in planes], axis=-1).astype(np.uint8)


def depth_scene(number: int) -> np.ndarray:
    """Return a depth image [mm]: a slope from 2 m on, shifted by number; a corner is unknown."""
    rows, columns = np.mgrid[:SIDE, :SIDE]
    depth = (2000 + 50 * rows + columns + number).astype(np.uint16)
    depth[:8, :8] = 0
    return depth


def next_image(source: ImageSource) -> Image:
    """Return the next frame of a source, which says every 0.1 s that there is none yet."""
    for _ in range(1000):
        if (image := source.next_image()) is not None:
            return image
    raise TimeoutError


@contextmanager
def repeating(act: Callable[[int], None]) -> Iterator[None]:
    """Context manager: call ``act`` with 0, 1, 2 ... at 30 Hz from a thread."""
    clock = MonotonicClock()

    def run(stop: threading.Event) -> None:
        due_ns, number = clock.now_ns(), 0
        while not stop.wait(max(0, due_ns - clock.now_ns()) / NS_PER_S):
            act(number)
            number += 1
            due_ns += round(NS_PER_S / HZ)

    worker = Worker("test-sender", run)
    worker.start()
    try:
        yield
    finally:
        worker.join(5)


class UdpSender:
    """Sends pictures as a racing simulator does: chunks in reverse order, each one twice."""

    def __init__(self, port: int, host: str = "127.0.0.1") -> None:
        self._address = (host, port)
        self._socket = socket.socket(
            socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM
        )

    def send(self, frame_id: int, data: bytes, *, stamp_ns: int = 0) -> None:
        for chunk in chunks(frame_id, data, stamp_ns=stamp_ns)[::-1]:
            for _ in range(2):
                self.send_raw(chunk)

    def send_raw(self, datagram: bytes) -> None:
        self._socket.sendto(datagram, self._address)

    def __enter__(self) -> "UdpSender":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: object, trace: TracebackType | None
    ) -> None:
        self._socket.close()


class RtpSender:
    """Sends H.264 over RTP; ``describe`` writes the session description that a receiver needs."""

    def __init__(self, port: int) -> None:
        self._port = port
        self._container = av.open(f"rtp://127.0.0.1:{port}", "w", format="rtp")
        stream: Any = self._container.add_stream("libx264", HZ)
        stream.width = stream.height = SIDE * 2
        stream.pix_fmt = "yuv420p"
        stream.options = {
            "preset": "ultrafast",
            "tune": "zerolatency",
            "g": "10",
            "x264-params": "repeat-headers=1",
        }
        self._stream = stream
        self._count = 0

    def describe(self, path: Path) -> Path:
        path.write_text(
            "v=0\no=- 0 0 IN IP4 127.0.0.1\ns=camera\nc=IN IP4 127.0.0.1\nt=0 0\n"
            f"m=video {self._port} RTP/AVP 96\na=rtpmap:96 H264/90000\n"
            "a=fmtp:96 packetization-mode=1\n"
        )
        return path

    def send(self, rgb: np.ndarray) -> None:
        frame = av.VideoFrame.from_ndarray(np.kron(rgb, np.ones((2, 2, 1), np.uint8)), "rgb24")
        frame.pts, frame.time_base = self._count, Fraction(1, HZ)
        self._count += 1
        for packet in self._stream.encode(frame):
            self._container.mux(packet)

    def close(self) -> None:
        self._container.close()


class FakeCapture:
    """Stands in for cv2.VideoCapture; stamps of -1 and -2 are frames that cannot be decoded."""

    def __init__(self, stamps_ms: Iterable[float], *, fps: float = 0.0) -> None:
        self.settings: dict[int, float] = {}
        self._fps = fps
        self._stamps_ms = list(stamps_ms)
        self._stamp_ms = 0.0

    def isOpened(self) -> bool:
        return True

    def set(self, property_id: int, value: float) -> None:
        self.settings[property_id] = value

    def get(self, property_id: int) -> float:
        return self._fps if property_id == cv2.CAP_PROP_FPS else self._stamp_ms

    def grab(self) -> bool:
        if not self._stamps_ms:
            return False
        self._stamp_ms = self._stamps_ms.pop(0)
        return True

    def retrieve(self) -> tuple[bool, np.ndarray | None]:
        if self._stamp_ms == -2:
            return True, None  # as OpenCV's own decoder of MJPEG
        return self._stamp_ms >= 0, np.array([[[1, 2, 3]]], np.uint8)

    def release(self) -> None:
        pass
