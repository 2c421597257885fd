"""The process that turns frames into a video and its table, and keeps the log of the link.

It ends by itself, with everything closed, also when its producer is killed: then the pipe ends. The
log has a pipe of its own, from another process, whose end it awaits last. A signal to the process
group (Ctrl-C) is the producer's to act on. Imports neither the loops nor the network, so that it
starts quickly.
"""

import os
import signal
from enum import Enum, auto
from multiprocessing.connection import Connection
from typing import NamedTuple, TypeAlias

from mavbridge.recording.rows import FrameRow
from mavbridge.recording.tlog import TlogJob, TlogThread
from mavbridge.recording.video.frame_files import FILE_ERRORS, FrameFiles, VideoJob
from mavbridge.recording.video.ring import FrameRing, RingShape

IDLE_S = 0.5
"""Longest wait of rows for a next frame."""
TLOG_S = 60.0
"""Longest wait for the end of the log once the producer is gone: the process of the link has the
vehicle to bring to safety."""
NICENESS = 10


class Submit(NamedTuple):
    """Message to the writer: this slot holds a frame."""

    slot: int
    row: FrameRow


class Written(NamedTuple):
    """Message from the writer: the frame of this slot is in the file; the slot is free."""

    slot: int


class Failed(NamedTuple):
    """Message from the writer: it has failed; it closes its files, and ends. ``reason`` is for the
    user, a sentence without its full stop."""

    reason: str


class Notice(Enum):
    """A message without contents."""

    FINISH = auto()
    """Sent to the writer: there are no more frames."""
    READY = auto()
    """Sent by the writer: it runs."""
    MAPPED = auto()
    """Sent by the writer: it has mapped the memory, whose name is not needed any more."""
    DONE = auto()
    """Sent by the writer: everything is closed."""


ToWriter: TypeAlias = RingShape | Submit | Notice
"""A ``RingShape`` comes first: the frames will lie there."""
FromWriter: TypeAlias = Written | Failed | Notice


def run_writer(
    pipe: "Connection[FromWriter, ToWriter]",
    job: VideoJob,
    niceness: int,
    tlog_job: TlogJob | None,
) -> None:
    """Entry point of the process."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGTSTP"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    if niceness:
        os.nice(niceness)
    tlog = None if tlog_job is None else TlogThread(tlog_job)
    service = WriterService(pipe, job, tlog)
    service.send(Notice.READY)
    while service.is_open:
        service.serve(IDLE_S)
    if tlog is not None:
        tlog.finish(0.0 if service.has_failed else TLOG_S)


class WriterService:
    """Does one job, message by message."""

    def __init__(
        self,
        pipe: "Connection[FromWriter, ToWriter]",
        job: VideoJob,
        tlog: TlogThread | None = None,
    ) -> None:
        self._pipe = pipe
        self._tlog = tlog
        self._files = FrameFiles(job)
        self._folder = job.video.parent
        self._ring: FrameRing | None = None
        self.is_open = True
        self.has_failed = False

    def send(self, message: FromWriter) -> None:
        """Send a message, if the producer is still there."""
        try:
            self._pipe.send(message)
        except OSError:
            return

    def serve(self, timeout_s: float) -> None:
        """Wait for one message and handle it."""
        if self._tlog is not None and self._tlog.failure is not None:
            self._fail("log of the link", self._tlog.failure)
            return
        try:
            if not self._pipe.poll(timeout_s):
                self._files.flush()
                return
            try:
                message = self._pipe.recv()
            except (EOFError, ConnectionResetError):  # the producer is gone
                message = Notice.FINISH
            self._handle(message)
        except FILE_ERRORS as error:
            self._fail("video", error)

    def _fail(self, what: str, error: Exception) -> None:
        self.has_failed = True
        self._files.abandon()
        self._close()
        reason = getattr(error, "strerror", None) or error
        self.send(Failed(f"the {what} cannot be written: {self._folder}: {reason}"))

    def _handle(self, message: ToWriter) -> None:
        match message:
            case RingShape():
                self._ring = FrameRing.attach(message)
                self.send(Notice.MAPPED)
            case Submit(slot=slot, row=row):
                if self._ring is None:
                    raise RuntimeError("a frame came before the ring was opened")
                self._files.append(self._ring.slot(slot), row)
                self.send(Written(slot))
            case Notice.FINISH:
                self._files.finish()
                self._close()
                self.send(Notice.DONE)

    def _close(self) -> None:
        self.is_open = False
        if self._ring is not None:
            self._ring.close()
            self._ring = None
