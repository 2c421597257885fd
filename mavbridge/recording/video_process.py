"""Process that encodes frames into a video, and keeps the log of the link; the video file.

It ends by itself with all files closed, even if its producer is killed: the pipe then ends. The log
has a separate pipe from another process, and the end of that pipe is awaited last. The producer
handles signals to the process group (Ctrl-C). Imports neither the loops nor the network, so that it
starts quickly.

Frames come through shared memory with a fixed number of slots. Messages over the pipe pass the
slots on and order the accesses: a slot belongs to the producer until ``Submit`` names it, and again
from ``Written`` on.
"""

import mmap
import os
import signal
import socket
import tempfile
from contextlib import suppress
from enum import Enum, auto
from fractions import Fraction
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, Never, TypeAlias

import av
import numpy as np
from av.container import OutputContainer
from av.error import FFmpegError

from mavbridge.core.clock import NS_PER_S, MonotonicClock
from mavbridge.core.records import CameraImage
from mavbridge.recording.tlog import TlogFile
from policy.data.flight_files import TLOG

MAX_SLOTS = 32
MIN_SLOTS = 4
MAX_BYTES = 32 << 20
"""Size limit of a ring with more than its least number of slots: some containers have only 64 MB of
shared memory."""


class Ring(NamedTuple):
    """Message to the writer: layout of the memory. Its file descriptor follows on the pipe."""

    slots: int
    frame: "np.dtype[np.void]"
    """Data type and axes of a frame."""


def ring_of(image: CameraImage) -> Ring:
    """Return the layout for frames like this one."""
    frame: np.dtype[np.void] = np.dtype((image.dtype, image.shape))
    return Ring(max(MIN_SLOTS, min(MAX_SLOTS, MAX_BYTES // frame.itemsize)), frame)


def allocate(ring: Ring) -> int:
    """Return the descriptor of a file without a name; raise OSError if there is no memory left.

    The memory is freed with its last descriptor, even if both processes are killed. Its pages are
    allocated now: a page that is unavailable at its first write ends the process.
    """
    size_bytes = ring.slots * ring.frame.itemsize
    shared = Path("/dev/shm")  # noqa: S108 - the system's place for shared memory
    has_shared = shared.is_dir()
    with tempfile.TemporaryFile(dir=shared if has_shared else None) as file:
        if has_shared:
            os.posix_fallocate(file.fileno(), 0, size_bytes)
        else:
            file.truncate(size_bytes)
        return os.dup(file.fileno())


def send_descriptor(pipe: "Connection[Any, Any]", descriptor: int) -> None:
    """Send a file descriptor over a duplex pipe; raise OSError if the receiver is gone.

    Never waits: since Python 3.14 ``multiprocessing.reduction.send_handle`` waits for an answer.
    """
    with socket.fromfd(pipe.fileno(), socket.AF_UNIX, socket.SOCK_STREAM) as carrier:
        socket.send_fds(carrier, [b"F"], [descriptor])


def receive_descriptor(pipe: "Connection[Any, Any]") -> int:
    """Return the file descriptor of ``send_descriptor``; raise EOFError if the sender is gone."""
    with socket.fromfd(pipe.fileno(), socket.AF_UNIX, socket.SOCK_STREAM) as carrier:
        _, descriptors, _, _ = socket.recv_fds(carrier, 1, 1)
    if not descriptors:
        raise EOFError
    return descriptors[0]


def map_ring(ring: Ring, descriptor: int) -> CameraImage:
    """Return the slots as an array, which keeps the memory mapped, and close the descriptor."""
    try:
        memory = mmap.mmap(descriptor, ring.slots * ring.frame.itemsize)
    finally:
        os.close(descriptor)
    return np.ndarray(ring.slots, ring.frame, memory)


class VideoJob(NamedTuple):
    """Files to write."""

    video: Path
    """Fragmented MP4; must not exist."""
    hz: float
    """Nominal frame rate."""
    tlog: "Connection[Never, Never] | None" = None
    """Records of the link's log, which is written beside the video."""


SURVIVED = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGTSTP)
"""Signals to the process group that the writer ignores: the producer tells it when to end."""
PERIOD_S = 0.05
"""Time between two reads of the log. Waking at each record would cost the link's process time."""
TLOG_S = 60.0
"""Longest wait for the end of the log once the producer is gone: the link's process still has to
bring the vehicle to safety."""
NICENESS = 10


class Submit(NamedTuple):
    """Message to the writer: this slot holds a frame."""

    slot: int
    captured_ns: int


class Written(NamedTuple):
    """Message from the writer: the frame of this slot is in the file; the slot is free."""

    slot: int


class Failed(NamedTuple):
    """Message from the writer: it has failed, closes its files and ends."""

    reason: str
    """Sentence for the user, without its full stop."""


class Notice(Enum):
    """A message without contents."""

    FINISH = auto()
    """Sent to the writer: no more frames."""
    READY = auto()
    """Sent by the writer: it runs."""
    DONE = auto()
    """Sent by the writer: everything is closed, but for a log that goes on."""
    KEEPS_LOG = auto()
    """Sent by the writer before ``DONE``: the log has not ended."""


ToWriter: TypeAlias = Ring | Submit | Notice
"""A ``Ring`` comes before the first frame."""
FromWriter: TypeAlias = Written | Failed | Notice


def run_writer(pipe: "Connection[FromWriter, ToWriter]", job: VideoJob, niceness: int) -> None:
    """Entry point of the process."""
    for number in SURVIVED:
        signal.signal(number, signal.SIG_IGN)
    os.nice(niceness)
    service = WriterService(pipe, job)
    service.send(Notice.READY)
    while service.is_open:
        service.serve(PERIOD_S)
    service.finish_log()


class WriterService:
    """Writer of one job, message by message."""

    def __init__(self, pipe: "Connection[FromWriter, ToWriter]", job: VideoJob) -> None:
        self._pipe = pipe
        self._tlog = None if job.tlog is None else TlogFile(job.video.with_name(TLOG), job.tlog)
        self._video = FragmentedMp4(job.video, job.hz)
        self._folder = job.video.parent
        self._slots: CameraImage | None = None
        self.is_open = True

    def send(self, message: FromWriter) -> None:
        """Send a message if the producer is still there."""
        try:
            self._pipe.send(message)
        except OSError:
            return

    def serve(self, timeout_s: float) -> None:
        """Wait for one message, copy the log, then handle the message."""
        what = "video"
        try:
            message = self._receive() if self._pipe.poll(timeout_s) else None
            what = "log of the link"
            if self._tlog is not None:
                self._tlog.copy()
            what = "video"
            match message:
                case Submit(slot=slot, captured_ns=captured_ns) if self._slots is not None:
                    self._video.append(self._slots[slot], captured_ns)
                    self.send(Written(slot))
                case Notice.FINISH:
                    self._video.close()
                    self.is_open = False
                    if self._tlog is not None and not self._tlog.has_ended:
                        self.send(Notice.KEEPS_LOG)
                    self.send(Notice.DONE)
        except WRITE_ERRORS as error:
            self._fail(what, error)

    def finish_log(self) -> None:
        """Copy the log to its end, for ``TLOG_S`` at most; after an error, leave it."""
        clock = MonotonicClock()
        until_ns = clock.now_ns() + round(TLOG_S * NS_PER_S)
        with suppress(OSError):
            while self._tlog is not None and not self._tlog.has_ended:
                if (now_ns := clock.now_ns()) > until_ns:
                    return
                self._tlog.copy()
                clock.sleep_until_ns(now_ns + round(PERIOD_S * NS_PER_S))

    def _receive(self) -> ToWriter:
        """Return the next message, or ``FINISH`` if the producer is gone; open the ring."""
        try:
            message = self._pipe.recv()
            if isinstance(message, Ring):
                self._slots = map_ring(message, receive_descriptor(self._pipe))
        except (EOFError, ConnectionResetError):
            return Notice.FINISH
        return message

    def _fail(self, what: str, error: Exception) -> None:
        self._tlog = None
        with suppress(*WRITE_ERRORS):  # a disk that was full is still full
            self._video.close()
        self.is_open = False
        reason = getattr(error, "strerror", None) or error
        self.send(Failed(f"the {what} cannot be written: {self._folder}: {reason}"))


CRF = "20"
"""Constant quality. 17 to 18 counts as visually lossless; 23 is x264's default."""
GOP_FRAMES = 30
"""One second between key frames."""
TIME_BASE = Fraction(1, 90_000)
"""Usual time base of video; the exact stamps are in the table."""
_OPTIONS: dict[str, object] = {
    "preset": "veryfast",
    "tune": "zerolatency",  # a frame in, a packet out
    "crf": CRF,
    "threads": "1",
    "g": str(GOP_FRAMES),
}
_DEPTH = "gray16le"
_FRAGMENTED = {"movflags": "frag_every_frame+empty_moov+default_base_moof"}
WRITE_ERRORS = (OSError, FFmpegError)
_BUFFER_BYTES = 1 << 20
"""Larger than a fragment, which is therefore written in one call that a kill cannot tear."""


class FragmentedMp4:
    """Video file that grows frame by frame. Methods can raise ``WRITE_ERRORS``."""

    def __init__(self, path: Path, hz: float) -> None:
        """Write to ``path``, created with the first frame, which gives the size and the kind.

        ``hz`` is the nominal frame rate; the stamps of the frames decide.
        """
        self._path, self._hz = path, hz
        self._file: BinaryIO | None = None
        self._first_ns: int | None = None
        self._last_pts = -1

    def _open(self, image: CameraImage) -> BinaryIO:
        self._file = file = self._path.open("xb", buffering=_BUFFER_BYTES)
        self._container: OutputContainer = av.open(file, "w", format="mp4", options=_FRAGMENTED)
        rate = Fraction(self._hz).limit_denominator(1000)
        if image.ndim == 2:  # depth
            self._stream = self._container.add_stream("ffv1", rate)
            self._stream.options = {"g": "1"}  # each image separately
        else:
            self._stream = self._container.add_stream("libx264", rate)
            self._stream.options = _OPTIONS
        self._stream.height, self._stream.width = image.shape[:2]
        self._stream.pix_fmt = _DEPTH if image.ndim == 2 else "yuv420p"
        self._stream.codec_context.time_base = TIME_BASE
        return file

    def append(self, image: CameraImage, captured_ns: int) -> None:
        """Encode one frame with even sides and hand it to the kernel.

        A stamp not later than the last frame's is moved behind it.
        """
        file = self._file or self._open(image)
        if self._first_ns is None:
            self._first_ns = captured_ns
        pts = max(self._last_pts + 1, (captured_ns - self._first_ns) * 9 // 100_000)
        pixels: Any = image
        frame = av.VideoFrame.from_ndarray(pixels, format="rgb24" if image.ndim == 3 else _DEPTH)
        frame.pts, frame.time_base = pts, TIME_BASE
        self._container.mux(self._stream.encode(frame))
        file.flush()
        self._last_pts = pts

    def close(self) -> None:
        """Write the remaining data and close the file, also after an error. Can be called twice."""
        file, self._file = self._file, None
        if file is None:
            return
        try:
            self._container.mux(self._stream.encode(None))
            self._container.close()
        finally:
            file.close()
