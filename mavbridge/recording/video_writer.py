"""Producer's end of the writer process."""

import multiprocessing
import os
import signal
import weakref
from collections import deque
from collections.abc import Callable
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Literal

from mavbridge.core.errors import MavbridgeError
from mavbridge.core.records import CameraImage
from mavbridge.recording.video_process import (
    NICENESS,
    SURVIVED,
    Failed,
    FromWriter,
    Notice,
    Submit,
    ToWriter,
    VideoJob,
    Written,
    allocate,
    map_ring,
    ring_of,
    run_writer,
    send_descriptor,
)

Pressure = Literal["online", "offline"]
"""With a full ring, online drops and counts the frame; offline makes the producer wait."""

START_S = 30.0
STALL_S = 30.0
"""Longest silence of a writer that has work."""
WAITS = 10
"""Parts of each timeout: a pause of both processes (Ctrl-Z) uses up only one."""
END_S = 5.0


class WriterError(MavbridgeError):
    """The writer could not write to the disk or the folder."""


class WriterDiedError(WriterError):
    """The writer process has died or hangs."""


class VideoWriter:
    """One video, written by a separate process. Used by one thread.

    Methods raise ``WriterError`` if the process has failed or died. If the producer is killed, the
    process notices and finishes the video. It outlives ``finish`` if the link's log has not ended
    by then, and waits for that by itself.
    """

    def __init__(self, job: VideoJob, *, pressure: Pressure) -> None:
        """Start the process and wait until it runs. The pipe of the job's log is closed here.

        ``pressure``: behaviour with a full ring. Online, the process yields the CPU to all others.
        """
        self._pressure: Pressure = pressure
        self._slots: CameraImage | None = None
        """Memory for frames; None before the first and after ``close``."""
        self._free: deque[int] = deque()
        self._failure: WriterError | None = None
        self._notices: set[Notice] = set()
        self.misfit: str | None = None
        """Why a frame was dropped that the video cannot have; None if there was none."""
        self.written = 0
        """Number of frames known to be in the file."""
        self._pipe, self._process = start_process(job, NICENESS if pressure == "online" else 0)
        # A policy's forks must not hide the producer's death from the writer.
        os.register_at_fork(after_in_child=self._pipe.close)
        # A producer that ends without ``close`` must not wait for its writer.
        weakref.finalize(self, self._pipe.close)
        try:
            self._wait_until(lambda: Notice.READY in self._notices, START_S)
        except WriterError:
            self.close()
            raise

    def submit(self, rgb: CameraImage, captured_ns: int) -> bool:
        """Hand a frame over; the caller can overwrite it afterwards. False: it was dropped.

        A frame that differs in size or kind from the first, or is one pixel high or wide, is a bug
        offline; online, it is dropped: see ``misfit``.

        Args:
            rgb: the image. An odd last row or column is cut off, which H.264 cannot have.
            captured_ns: its exposure.
        """
        self._receive()
        height, width = rgb.shape[:2]
        rgb = rgb[: height // 2 * 2, : width // 2 * 2]
        if self._slots is None and rgb.size:
            self._slots = self._open(rgb)
        slots = self._slots
        if slots is None or rgb.shape != slots.shape[1:]:
            self._see_misfit(height, width)
            slots = None
        elif self._pressure == "offline":
            self._wait_until(lambda: bool(self._free))
        if slots is None or not self._free:
            return False
        slot = self._free.popleft()
        slots[slot] = rgb
        self._send(Submit(slot, captured_ns))
        return True

    def _see_misfit(self, height: int, width: int) -> None:
        if self._slots is None:
            what = f"the camera's images of {width}x{height} are too small for a video"
        else:
            before = f"{self._slots.shape[2]}x{self._slots.shape[1]}"
            what = f"the camera's images have changed from {before} to {width}x{height}"
        if self._pressure == "offline":
            raise ValueError(what)
        self.misfit = self.misfit or what

    def _open(self, rgb: CameraImage) -> CameraImage:
        ring = ring_of(rgb)
        try:
            descriptor = allocate(ring)
        except OSError as error:
            self._failure = WriterError(
                f"no shared memory for frames of {rgb.shape[1]}x{rgb.shape[0]}: {error.strerror}; "
                "a container needs more of it (docker run --shm-size)"
            )
            raise self._failure from error
        try:
            self._send(ring)
            send_descriptor(self._pipe, descriptor)
        except OSError:
            raise self._died() from None
        finally:
            slots = map_ring(ring, descriptor)
        self._free.extend(range(ring.slots))
        return slots

    def finish(self) -> None:
        """Wait until every frame is on disk and the files are closed, and end the process."""
        try:
            self._send(Notice.FINISH)
            self._wait_until(lambda: Notice.DONE in self._notices)
        finally:
            self.close()

    def _send(self, message: ToWriter) -> None:
        """Send a message. Never blocks: no more messages are in flight than there are slots."""
        try:
            self._pipe.send(message)
        except OSError:  # it has ended; its last message or exit status gives the reason
            self._receive()
            raise self._died() from None

    def _wait_until(self, condition: Callable[[], bool], timeout_s: float = STALL_S) -> None:
        """Receive until the condition holds; a writer silent for ``timeout_s`` counts as hung."""
        self._receive()
        while not condition():
            if not any(
                wait([self._pipe, self._process.sentinel], timeout_s / WAITS) for _ in range(WAITS)
            ):
                self._failure = WriterDiedError(f"the writer process has hung for {timeout_s:g} s")
            self._receive()
            if self._process.exitcode is not None and not condition():
                self._receive()  # messages sent between the two checks
                if not condition():
                    raise self._died()

    def _receive(self) -> None:
        """Process the messages that have arrived."""
        try:
            while not self._failure and Notice.DONE not in self._notices and self._pipe.poll():
                match self._pipe.recv():
                    case Written(slot=slot):
                        self._free.append(slot)
                        self.written += 1
                    case Failed(reason=reason):
                        self._failure = WriterError(reason)
                    case Notice() as notice:
                        self._notices.add(notice)
        except (EOFError, OSError):
            raise self._died() from None
        if self._failure is not None:
            raise self._failure

    def _died(self) -> WriterError:
        if self._failure is None:
            code = self._process.exitcode
            how = "" if code is None else f" (exit status {code})"
            self._failure = WriterDiedError(f"the writer process has died{how}")
        return self._failure

    def close(self) -> None:
        """End the process; frames submitted but not written can be lost. Can be called twice."""
        self._slots = None
        self._pipe.close()
        if Notice.KEEPS_LOG in self._notices:
            return
        self._process.join(END_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join(END_S)


def start_process(
    job: VideoJob, niceness: int
) -> "tuple[Connection[ToWriter, FromWriter], BaseProcess]":
    """Start the writer's process; return the pipe to it and the process."""
    context = multiprocessing.get_context("spawn")  # not fork: this process has running threads
    pipe, its_pipe = context.Pipe()
    process = context.Process(
        target=run_writer, args=(its_pipe, job, niceness), name="mavbridge-writer", daemon=True
    )
    resource_tracker.ensure_running()  # its start unblocks signals
    # Blocked until the process ignores them: a Ctrl-C would end its start.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SURVIVED)
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        its_pipe.close()  # an open copy here would keep the pipe open after the writer dies
        if job.tlog is not None:
            job.tlog.close()
    return pipe, process
