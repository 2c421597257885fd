"""The producer's end of the writer process."""

import multiprocessing
import weakref
from collections import deque
from dataclasses import replace
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Literal, Protocol

from mavbridge.core.errors import MavbridgeError
from mavbridge.core.records import ImageArray
from mavbridge.recording.rows import FrameRow
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
from mavbridge.recording.video.writer_process import run_writer

Pressure = Literal["online", "offline"]
"""What a full ring does. online: the frame is dropped and counted. offline: the producer waits."""

START_S = 30.0
STALL_S = 30.0
"""Silence of a writer that has work."""
END_S = 5.0


class WriterError(MavbridgeError):
    """The writer could not write: the disk, the folder."""


class WriterDiedError(WriterError):
    """The writer process is gone, or hangs."""


class Liveness(Protocol):
    """The process at the other end of the pipe, as far as the sender needs it."""

    @property
    def sentinel(self) -> int:
        """Readable once the process has ended."""
        ...

    @property
    def exitcode(self) -> int | None:
        """None while it runs."""
        ...


class FrameSender:
    """Frames into the ring, and news of the writer out of the pipe; used by one thread."""

    def __init__(
        self, pipe: "Connection[ToWriter, FromWriter]", process: Liveness, *, pressure: Pressure
    ) -> None:
        self._pipe = pipe
        self._process = process
        self._pressure: Pressure = pressure
        self._ring: FrameRing | None = None
        self._free: deque[int] = deque()
        self._failure: WriterError | None = None
        self._pending_drops = 0
        self.is_ready = False
        self.is_done = False
        self.offered = 0
        self.written = 0

    @property
    def size(self) -> tuple[int, int] | None:
        """Height and width of the recorded frames; None before the first."""
        return None if self._ring is None else (self._ring.shape.height, self._ring.shape.width)

    def submit(self, rgb: ImageArray, row: FrameRow) -> bool:
        """See ``VideoWriter.submit``."""
        self.offered += 1
        self.receive()
        rgb = even(rgb)
        if self._ring is None:
            self._open(rgb)
        is_same_size = rgb.shape[:2] == self.size
        if self._pressure == "offline":
            if not is_same_size:
                raise ValueError(f"a frame of {rgb.shape} in a video of {self.size}")
            self.wait_until(lambda: bool(self._free))
        if not (self._free and is_same_size):
            self._pending_drops += 1 + row.dropped_before
            return False
        self._put(rgb, row)
        return True

    def _open(self, rgb: ImageArray) -> None:
        height, width = rgb.shape[:2]
        try:
            self._ring = FrameRing.create(height, width)
        except OSError as error:
            self._failure = WriterError(
                f"no shared memory for frames of {width}x{height}: {error.strerror}; a container "
                "needs more of it (docker run --shm-size)"
            )
            raise self._failure from error
        self._free.extend(range(self._ring.shape.slots))
        self._send(Open(self._ring.shape))

    def _put(self, rgb: ImageArray, row: FrameRow) -> None:
        if self._ring is None:
            raise RuntimeError("a frame without a ring")
        slot = self._free.popleft()
        self._ring.slot(slot)[:] = rgb
        dropped = row.dropped_before + self._pending_drops
        self._pending_drops = 0
        self._send(Submit(slot, replace(row, dropped_before=dropped)))

    def finish(self) -> None:
        """Say that this was all, and wait until everything is on disk."""
        self._send(Finish())
        self.wait_until(lambda: self.is_done)

    def _send(self, message: ToWriter) -> None:
        """Cannot block: no more messages are under way than there are slots."""
        try:
            self._pipe.send(message)
        except OSError:  # it is gone: its last words, or else its end, tell why
            self.receive()
            raise self._died() from None

    def wait_until(self, condition: "Condition", timeout_s: float = STALL_S) -> None:
        """Take news until the condition holds.

        Raises:
            WriterError: the writer failed, died, or said nothing for that long.
        """
        while not condition():
            if not wait([self._pipe, self._process.sentinel], timeout_s):
                self._failure = WriterDiedError(f"the writer process has hung for {timeout_s:g} s")
            self.receive()
            if self._process.exitcode is not None and not condition():
                self.receive()  # what it said between the two
                if not condition():
                    raise self._died()

    def receive(self) -> None:
        """Take the news that are there.

        Raises:
            WriterError: the writer failed, or died.
        """
        try:
            while self._failure is None and not self.is_done and self._pipe.poll():
                self._take(self._pipe.recv())
        except (EOFError, OSError):
            raise self._died() from None
        if self._failure is not None:
            raise self._failure

    def _take(self, message: FromWriter) -> None:
        match message:
            case Written(slot=slot):
                self._free.append(slot)
                self.written += 1
            case Opened():
                if self._ring is not None:
                    self._ring.unlink()
            case Failed(reason=reason):
                self._failure = WriterError(f"the video cannot be written: {reason}")
            case Ready():
                self.is_ready = True
            case Done():
                self.is_done = True

    def _died(self) -> WriterError:
        if self._failure is None:
            code = self._process.exitcode
            how = "" if code is None else f" (exit status {code})"
            self._failure = WriterDiedError(f"the writer process has died{how}")
        return self._failure

    def close(self) -> None:
        """Free the memory and the pipe."""
        self._pipe.close()
        if self._ring is not None:
            self._ring.close()


class Condition(Protocol):
    """Something to wait for."""

    def __call__(self) -> bool:
        """It holds."""
        ...


class VideoWriter:
    """One video, written by a process of its own; used by one thread, and a context manager.

    A producer that is killed leaves a whole video: the writer notices and finishes it.
    """

    def __init__(
        self,
        video: Path,
        *,
        pressure: Pressure,
        hz: float,
        rows: Path | None = None,
        with_truth: bool = False,
    ) -> None:
        """Start the process and see it run.

        Args:
            video: MP4 file to make; must not exist.
            pressure: what a full ring does.
            hz: nominal frame rate.
            rows: path and stem of a frames table to make, or None.
            with_truth: the table has the columns of ``FrameTruth``.

        Raises:
            WriterError: it does not start.
        """
        job = VideoJob(
            video=video, rows=rows, with_truth=with_truth, hz=hz, yield_cpu=pressure == "online"
        )
        # Not fork: threads and an engine run here.
        context = multiprocessing.get_context("spawn")
        pipe, its_pipe = context.Pipe()
        self._process = context.Process(
            target=run_writer, args=(its_pipe, job), name="mavbridge-writer", daemon=True
        )
        self._process.start()
        its_pipe.close()  # else its end would not be heard here
        self._sender = FrameSender(pipe, self._process, pressure=pressure)
        # A producer that ends without ``close`` must not be waited for by its writer.
        self._release = weakref.finalize(self, self._sender.close)
        try:
            self._sender.wait_until(lambda: self._sender.is_ready, START_S)
        except WriterError:
            self.close()
            raise

    def __enter__(self) -> "VideoWriter":
        """Nothing more to do."""
        return self

    def __exit__(self, failure: type[BaseException] | None, *_: object) -> None:
        """Finish, or after an exception only close."""
        if failure is None:
            self.finish()
        else:
            self.close()

    def submit(self, rgb: ImageArray, row: FrameRow) -> bool:
        """Hand a frame over; it may be overwritten afterwards.

        A frame of another size than the first is dropped and counted online, a bug offline.

        Args:
            rgb: [H, W, 3] uint8; an odd last row or column is cut off, which H.264 cannot have.
            row: what else is known of it; drops of the ring are added to ``dropped_before``.

        Returns:
            Whether it was taken.

        Raises:
            WriterError: the writer failed or died, now or before.
        """
        return self._sender.submit(rgb, row)

    def finish(self) -> None:
        """Wait until every frame is on disk and the files are closed.

        Raises:
            WriterError: they are not all there.
        """
        try:
            self._sender.finish()
        finally:
            self.close()

    def close(self) -> None:
        """End the process; what was submitted and not written may be lost. May be called twice."""
        self._release()
        self._process.join(END_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join(END_S)

    @property
    def size(self) -> tuple[int, int] | None:
        """Height and width of the recorded frames; None before the first."""
        return self._sender.size

    @property
    def written(self) -> int:
        """Frames known to be in the file."""
        return self._sender.written

    @property
    def lost(self) -> int:
        """Frames offered and not, or not yet, in the file."""
        return self._sender.offered - self._sender.written

    @property
    def pid(self) -> int | None:
        """The process."""
        return self._process.pid


def even(rgb: ImageArray) -> ImageArray:
    """The image without an odd last row or column: a view."""
    height, width = rgb.shape[:2]
    return rgb[: height // 2 * 2, : width // 2 * 2]
