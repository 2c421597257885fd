"""Flights to record: images that show their number, a meta, and a writer without a process."""

import os
import re
import resource
import signal
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from helpers.factories import START_NS, make_vision_tick
from mavbridge.core.records import CameraImage, ImageArray, Tick, VisionTick
from mavbridge.recording import flight_writer
from mavbridge.recording.flight_writer import FlightWriter
from mavbridge.recording.folder import FlightMeta
from mavbridge.recording.rows import FrameRow
from mavbridge.recording.video_process import FragmentedMp4, VideoJob
from policy.contract import Contract
from policy.data.flight_video import decode_images, whole_images

_BITS = 12
_BLOCK = 16


def picture(number: int, *, height: int = 48, width: int = 64) -> ImageArray:
    """Return an image that still shows its number after H.264: one block per bit."""
    rgb = np.full((height, width, 3), 128, np.uint8)
    for bit in range(_BITS):
        y, x = _BLOCK * (bit // 4), _BLOCK * (bit % 4)
        rgb[y : y + _BLOCK, x : x + _BLOCK] = 255 * (number >> bit & 1)
    return rgb


def number_of(rgb: ImageArray) -> int:
    half = _BLOCK // 2
    return sum(
        int(rgb[_BLOCK * (bit // 4) + half, _BLOCK * (bit % 4) + half, 1] > 127) << bit
        for bit in range(_BITS)
    )


def count_frames(path: Path) -> int:
    return whole_images(path)[0]


def fragment(data: bytes | bytearray, number: int) -> tuple[int, int]:
    """Return start and end of an image's boxes, from 0, in the bytes of a video."""
    starts = [found.start() - 4 for found in re.finditer(b"moof....mfhd", data, re.DOTALL)]
    end = [*starts, bytes(data).rfind(b"mfra") - 4][number + 1]
    return starts[number], end


def read_video(path: Path) -> Iterator[CameraImage]:
    """Return all decodable images of a video."""
    return decode_images(path, count_frames(path))


def make_frame(number: int, **changes: Any) -> VisionTick:
    """Return frame ``number``, from 0, with its picture."""
    return replace(make_vision_tick(number + 1, rgb=picture(number)), **changes)


def make_row(number: int, **changes: Any) -> FrameRow:
    vision = make_vision_tick(number + 1)
    row = FrameRow(
        frame_id=number, captured_ns=vision.captured_ns, ready_ns=vision.ready_ns, dropped_before=0
    )
    return replace(row, **changes)


def make_meta(**changes: Any) -> FlightMeta:
    """Return the meta of a flight at 100 and 30 Hz."""
    meta = FlightMeta(
        started_at="2026-01-02T03:04:05+00:00",
        start_ns=START_NS,
        source="flight",
        policy="scripted:hover",
        engine="torch",
        mode="dual",
        action_hz=100.0,
        visual_hz=30.0,
        contract=Contract(),
    )
    return replace(meta, **changes)


class InProcessWriter:
    """Replaces ``VideoWriter`` where its process is not under test: starting it takes a second."""

    misfit = None

    def __init__(self, job: VideoJob, *, pressure: str) -> None:
        if job.tlog is not None:
            job.tlog.close()
        self._video = FragmentedMp4(job.video, job.hz)
        self.written = 0

    def submit(self, rgb: CameraImage, captured_ns: int) -> bool:
        height, width = rgb.shape[0] // 2 * 2, rgb.shape[1] // 2 * 2
        self._video.append(rgb[:height, :width], captured_ns)
        self.written += 1
        return True

    def finish(self) -> None:
        self.close()

    def close(self) -> None:
        self._video.close()


@contextmanager
def without_writer_process() -> Iterator[None]:
    """Context manager: write flights in the calling thread."""
    with patch.object(flight_writer, "VideoWriter", InProcessWriter):
        yield


@contextmanager
def disk_of(limit_bytes: int) -> Iterator[None]:
    """No file of this process grows beyond that."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def send_signal(pid: int, number: signal.Signals) -> None:
    """Stop, kill or continue a child, and wait until it is done: ``os.kill`` returns earlier."""
    os.kill(pid, number)
    if number != signal.SIGCONT:
        with suppress(ChildProcessError):  # another thread of its parent has waited for it
            os.waitid(os.P_PID, pid, os.WEXITED | os.WSTOPPED | os.WNOWAIT)


def write_recording(
    folder: Path,
    events: Iterable[Tick | VisionTick],
    *,
    meta: FlightMeta | None = None,
    finish: bool = True,
) -> Path:
    """A flight of ``events``; without ``finish``, as a kill leaves it."""
    folder.mkdir()
    with without_writer_process():
        writer = FlightWriter(folder, meta or make_meta(), pressure="offline")
        for event in events:
            if isinstance(event, Tick):
                writer.tick(event)
            else:
                writer.frame(event)
        if finish:
            writer.finish(writer.meta)
        else:
            writer.flush()
            writer.close()
    return folder
