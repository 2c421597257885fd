"""The process that turns frames into a video and its table.

It ends by itself, with everything closed, also when its producer is killed: then the pipe ends. A
signal to the process group (Ctrl-C) is the producer's to act on. Imports neither the loops nor the
network, so that it starts quickly.
"""

import os
import signal
from multiprocessing.connection import Connection

from mavbridge.recording.rows import FrameRow
from mavbridge.recording.schema import DEMONSTRATION_FRAMES, FRAMES, frames_batch
from mavbridge.recording.tables import READ_ERRORS, TableWriter
from mavbridge.recording.video.file import WRITE_ERRORS, FragmentedMp4
from mavbridge.recording.video.messages import (
    Done,
    Failed,
    Finish,
    FromWriter,
    Open,
    Opened,
    Ready,
    Submit,
    ToWriter,
    VideoJob,
    Written,
)
from mavbridge.recording.video.ring import FrameRing

FLUSH_NS = 500_000_000
"""Longest span of frames whose rows may wait."""
FLUSH_ROWS = 64
IDLE_S = 0.5
"""Rows do not wait longer than this for a next frame, either."""
NICENESS = 10


def run_writer(pipe: "Connection[FromWriter, ToWriter]", job: VideoJob) -> None:
    """Entry point of the process."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    if job.yield_cpu:
        os.nice(NICENESS)
    service = WriterService(pipe, job)
    service.tell(Ready())
    while service.is_open:
        service.serve(IDLE_S)


class WriterService:
    """One job, message by message."""

    def __init__(self, pipe: "Connection[FromWriter, ToWriter]", job: VideoJob) -> None:
        self._pipe = pipe
        self._job = job
        self._ring: FrameRing | None = None
        self._video: FragmentedMp4 | None = None
        self._table: TableWriter | None = None
        self._rows: list[FrameRow] = []
        self.is_open = True

    def tell(self, message: FromWriter) -> None:
        """Say something, if there is still somebody to hear it."""
        try:
            self._pipe.send(message)
        except OSError:
            return

    def serve(self, timeout_s: float) -> None:
        """Wait for one message and do what it says."""
        try:
            if not self._pipe.poll(timeout_s):
                self._flush()
                return
            self._handle(self._pipe.recv())
        except (EOFError, ConnectionResetError):  # the producer is gone
            self._end()
        except WRITE_ERRORS as error:
            self._fail(error)

    def _handle(self, message: ToWriter) -> None:
        match message:
            case Open(shape=shape):
                self._ring = FrameRing.attach(shape)
                self.tell(Opened())
                self._video = FragmentedMp4(
                    self._job.video, height=shape.height, width=shape.width, hz=self._job.hz
                )
            case Submit(slot=slot, row=row):
                self._write(slot, row)
                self.tell(Written(slot))
            case Finish():
                self._end()

    def _write(self, slot: int, row: FrameRow) -> None:
        if self._ring is None or self._video is None:
            raise RuntimeError("a frame came before the ring was opened")
        self._video.append(self._ring.slot(slot), row.captured_ns)
        self._rows.append(row)
        is_due = row.captured_ns - self._rows[0].captured_ns >= FLUSH_NS
        if is_due or len(self._rows) >= FLUSH_ROWS:
            self._flush()

    def _flush(self) -> None:
        if self._job.rows is None or not self._rows:
            self._rows.clear()
            return
        schema = DEMONSTRATION_FRAMES if self._job.with_truth else FRAMES
        if self._table is None:
            self._table = TableWriter(self._job.rows, schema)
        self._table.append(frames_batch(self._rows, schema))
        self._rows.clear()

    def _end(self) -> None:
        """Close everything in order."""
        try:
            if self._video is not None:
                self._video.close()
                self._video = None
            self._flush()
            if self._table is not None:
                table, self._table = self._table, None
                table.finish()
        except (*WRITE_ERRORS, *READ_ERRORS) as error:
            self._fail(error)
            return
        self._close()
        self.tell(Done())

    def _fail(self, error: Exception) -> None:
        """Leave what is written; the file that failed may be cut off at its end."""
        for finish in (self._close_video, self._flush):
            try:
                finish()
            except (*WRITE_ERRORS, *READ_ERRORS):
                continue  # the disk that was full still is
        if self._table is not None:
            self._table.abandon()
        self._close()
        reason = getattr(error, "strerror", None) or str(error)
        self.tell(Failed(f"{self._job.video.parent}: {reason}"))

    def _close_video(self) -> None:
        if self._video is not None:
            video, self._video = self._video, None
            video.close()

    def _close(self) -> None:
        self.is_open = False
        if self._ring is not None:
            self._ring.close()
            self._ring = None
