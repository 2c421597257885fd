"""A rollout's output beside its loop: a thread decodes, the writer process writes."""

import queue
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Event

from mavbridge.commands.imagine.files import RolloutError, RowsWriter, rollout_frames
from mavbridge.commands.imagine.loop import Segment
from mavbridge.commands.imagine.output import FrameDigest, OnFrame, frame_row
from mavbridge.commands.imagine.pixels import Latents, make_frame_source
from mavbridge.commands.imagine.plan import RolloutPlan
from mavbridge.commands.imagine.sampling import Sampler, one_core
from mavbridge.core.clock import NS_PER_S, Clock
from mavbridge.core.records import ImageArray, RolloutFrame
from mavbridge.core.workers import HungError, Worker
from mavbridge.recording.video.writer import VideoWriter

QUEUED_SEGMENTS = 2
"""That may wait for the decoder; then the loop waits. The slowest part sets the pace."""
STALL_S = 120.0
"""Longest time in which not one frame gets through."""
END_S = 45.0
"""Longer than a writer process that hangs is waited for."""
_POLL_S = 0.1


@dataclass(frozen=True, kw_only=True)
class _Job:
    """A segment on its way to the thread."""

    frames: tuple[RolloutFrame, ...]
    decoded: dict[int, ImageArray]
    missing: Latents | None
    """Of the frames that are not decoded yet, in order; None: the video is not wanted."""


class StreamedOutput:
    """Frames and rows go to the disk as they come; see ``Output``."""

    def __init__(
        self,
        out: Path,
        sampler: Sampler,
        plan: RolloutPlan,
        *,
        decode_video: bool,
        clock: Clock,
        on_frame: OnFrame,
    ) -> None:
        """Create the files, start the writer process and the thread.

        Args:
            out: from ``prepare_out``.
            sampler: of the rollout.
            plan: of the rollout.
            decode_video: whether there is to be a video; the rows are written in any case.
            clock: for deadlines.
            on_frame: looks on, from the thread.

        Raises:
            MavbridgeError: the files cannot be made, or the writer process does not start.
        """
        self._plan = plan
        self._frame_dt_s = sampler.config.frame_dt_s
        self._meter = sampler.meter
        self._source = make_frame_source(sampler.model)
        self._clock = clock
        self._on_frame = on_frame
        self._digest = FrameDigest()
        self.frames = self.frames_decoded = 0
        self._jobs: queue.Queue[_Job | None] = queue.Queue(QUEUED_SEGMENTS)
        self._rows = RowsWriter(out)
        self._video: VideoWriter | None = None
        if decode_video:
            try:
                self._video = VideoWriter(out, pressure="offline", hz=1 / self._frame_dt_s)
            except BaseException:
                self._rows.abandon()
                raise
        self._worker = Worker("mavbridge-rollout-decode", self._serve)
        self._worker.start()

    @property
    def decode_queue(self) -> int:
        """Segments that wait to be decoded."""
        return self._jobs.qsize()

    @property
    def writer_queue(self) -> int:
        """Frames that wait to be written."""
        return 0 if self._video is None else self._video.lost

    @property
    def writer_pid(self) -> int | None:
        """The writer process, where there is one."""
        return None if self._video is None else self._video.pid

    @property
    def sha256(self) -> str:
        """Of all frames so far, raw, in their order."""
        return self._digest.hexdigest()

    def put(self, segment: Segment) -> None:
        """Queue a segment; waits while the queue is full.

        Raises:
            MavbridgeError: the thread has failed, or is stuck.
        """
        frames = tuple(rollout_frames(segment, self._plan, self._frame_dt_s))
        missing = None
        if self._video is not None:
            rows = [row for row in range(len(frames)) if row not in segment.decoded]
            missing = Latents(segment.latents[rows])
        with self._meter.decode:
            self._hand_over(_Job(frames=frames, decoded=segment.decoded, missing=missing))

    def _hand_over(self, job: _Job | None, on_wait: Callable[[], None] = lambda: None) -> None:
        def put() -> bool:
            self._require_worker()
            try:
                self._jobs.put(job, timeout=_POLL_S)
            except queue.Full:
                return False
            return True

        self._wait_for(put, on_wait)

    def _wait_for(self, condition: Callable[[], bool], on_wait: Callable[[], None]) -> None:
        """Until it holds, as long as frames get through; the condition waits a little itself."""
        seen, since_ns = self.frames, self._clock.now_ns()
        while not condition():
            on_wait()
            if self.frames != seen:
                seen, since_ns = self.frames, self._clock.now_ns()
            elif self._clock.now_ns() - since_ns > STALL_S * NS_PER_S:
                raise HungError(f"no frame has been decoded and written for {STALL_S:g} s")

    def _require_worker(self) -> None:
        """Raise what the thread has raised."""
        if not self._worker.is_alive:
            self._worker.join(END_S)
            raise RuntimeError("the thread ended before its work did")

    def finish(self, on_wait: Callable[[], None] = lambda: None) -> None:
        """Work off the queue, close the files, count.

        Raises:
            MavbridgeError: it could not all be written.
        """
        with self._meter.decode:
            self._hand_over(None, on_wait)
            self._wait_for(lambda: self._worker.ends_within(_POLL_S), on_wait)
            self._worker.join(END_S)
        with self._meter.write:
            if self._video is not None:
                self._video.finish()
                if self._video.written != self._rows.rows:
                    raise RolloutError(
                        f"{self._video.written} frames were written for {self._rows.rows} rows"
                    )
            self._rows.finish()

    def close(self) -> None:
        """Stop the thread and the writer; what is written stays readable."""
        with suppress(BaseException):  # it is what led here
            self._worker.join(END_S)
        if self._video is not None:
            self._video.close()
        self._rows.abandon()

    def _serve(self, stop: Event) -> None:
        """The thread."""
        with one_core():
            while not stop.is_set():
                try:
                    job = self._jobs.get(timeout=_POLL_S)
                except queue.Empty:
                    continue
                if job is None:
                    return
                self._write(job, stop)

    def _write(self, job: _Job, stop: Event) -> None:
        # First: after a crash there may be rows without a frame, but no frame without a row.
        self._rows.append(job.frames)
        images = None if job.missing is None else self._source.frames(job.missing)
        for frame in job.frames:
            if stop.is_set():
                return
            rgb = None
            if self._video is not None and images is not None:
                rgb = job.decoded.get(frame.frame)
                if rgb is None:
                    rgb = next(images)
                    self.frames_decoded += 1
                self._digest.add(rgb)
                self._video.submit(rgb, frame_row(frame, self._clock))
            self._on_frame(frame, rgb)
            self.frames += 1
