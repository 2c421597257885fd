"""Writer of a rollout's segments: ``NAME.mp4``, and ``NAME.parquet`` with a row per frame.

While it grows, and after a crash, the table is ``NAME.arrows``, as with recorded flights. A thread
decodes, the writer process writes.
"""

import hashlib
import queue
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from threading import Event
from typing import TypeAlias

import numpy as np
import pyarrow as pa
import torch
from torch import Tensor

from mavbridge.commands.imagine.loop import (
    RolloutError,
    RolloutPlan,
    Sampler,
    Segment,
    torch_threads,
)
from mavbridge.core.clock import NS_PER_S, Clock
from mavbridge.core.errors import UserError
from mavbridge.core.files import require_writable
from mavbridge.core.records import ImageArray, RolloutFrame
from mavbridge.core.workers import HungError, Worker
from mavbridge.recording.folder import require_extra
from mavbridge.recording.rows import FrameRow
from mavbridge.recording.tables import TableWriter
from mavbridge.recording.video.file import WRITE_ERRORS
from mavbridge.recording.video.writer import VideoWriter
from mavbridge.recording.video.writer_process import VideoJob
from policy.contract import ACTION_DIM, STATE_DIM

SCHEMA = pa.schema(
    [
        pa.field("iteration", pa.int32(), nullable=False),
        pa.field("frame", pa.int32(), nullable=False),
        pa.field("executed", pa.bool_(), nullable=False),
        pa.field("time_s", pa.float64(), nullable=False),
        pa.field("state", pa.list_(pa.float32(), STATE_DIM), nullable=False),
        pa.field("action", pa.list_(pa.float32(), ACTION_DIM), nullable=False),
    ]
)
"""Columns described in docs/formats.md, named after the attributes of ``RolloutFrame``."""

OnFrame: TypeAlias = Callable[[RolloutFrame, ImageArray | None], None]
"""Called for every frame [H, W, 3] in the video's order, by one thread; None: not decoded."""


def prepare_out(out: Path) -> None:
    """Check that a rollout can be written here.

    Raises:
        UserError: the extra is not installed, the name is taken or not .mp4, or is not writable.
    """
    require_extra("imagine")
    if out.suffix != ".mp4":
        raise UserError(f"--out {out} must end in .mp4")
    for path in (out, out.with_suffix(".arrows"), out.with_suffix(".parquet")):
        if path.exists():
            raise UserError(f"{path} is there already: remove it, or name another --out")
    require_writable(out, "--out")


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Context manager: convert errors of writing a file to ``RolloutError``."""
    try:
        yield
    except WRITE_ERRORS as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise RolloutError(f"{path} cannot be written: {reason}") from error


QUEUED_SEGMENTS = 2
"""Capacity of the decoder's queue in segments; when it is full, the loop waits, so that the slowest
part sets the pace."""
STALL_S = 120.0
"""Longest time without a finished frame."""
END_S = 45.0
"""Longer than the timeout for a hung writer process."""
_POLL_S = 0.1


_Job: TypeAlias = tuple[Segment, torch.cuda.Event | None]
"""A segment, and the GPU event after which its latents can be read."""


class StreamedOutput:
    """Writes frames and rows of segments to disk as they come. Used by the loop's thread.

    Methods raise ``MavbridgeError`` if writing fails or has failed before.
    """

    def __init__(
        self,
        out: Path,
        sampler: Sampler,
        plan: RolloutPlan,
        *,
        clock: Clock,
        decode_video: bool = True,
        on_frame: OnFrame | None = None,
    ) -> None:
        """Open the output at ``out``; without ``decode_video``, only the rows."""
        self.out = out
        self._plan = plan
        self._model = sampler.model
        self._clock = clock
        self._frame_dt_s = sampler.config.frame_dt_s
        self._on_frame = on_frame
        self._digest = hashlib.sha256()
        self.frames = 0
        self.frames_decoded = 0
        """Frames decoded outside the loop's thread, whose own frames the sampler counts."""
        self._stream: torch.cuda.Stream | None = None
        """On a GPU, the decoder's stream beside the sampler's."""
        if (device := next(sampler.model.parameters()).device).type == "cuda":
            self._stream = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]
        self._jobs: queue.Queue[_Job | None] = queue.Queue(QUEUED_SEGMENTS)
        self._table_path = out.with_suffix(".arrows")
        self.video: VideoWriter | None = None
        with writing(self._table_path):
            self._table = TableWriter(out, SCHEMA)
        if decode_video:
            try:
                self.video = VideoWriter(VideoJob(out, 1 / self._frame_dt_s), pressure="offline")
            except BaseException:
                self._table.abandon()
                raise
        self._worker = Worker("mavbridge-rollout-decode", self._serve)
        self._worker.start()

    @property
    def sha256(self) -> str:
        """SHA-256 of all raw frames so far, in order."""
        return self._digest.hexdigest()

    @property
    def decode_queue(self) -> int:
        """Number of segments waiting to be decoded."""
        return self._jobs.qsize()

    def put(self, segment: Segment) -> None:
        """Queue a segment; wait while the queue is full."""
        ready = None
        if self.video is not None and segment.latents.is_cuda:
            ready = torch.cuda.current_stream(segment.latents.device).record_event()
        self._enqueue((segment, ready))

    def _enqueue(self, job: _Job | None, on_wait: Callable[[], None] = lambda: None) -> None:
        def was_put() -> bool:
            if not self._worker.is_alive:
                self._worker.join(END_S)  # raises the thread's exception
                raise RuntimeError("the thread ended before its work did")
            try:
                self._jobs.put(job, timeout=_POLL_S)
            except queue.Full:
                return False
            return True

        self._wait_until(was_put, on_wait)

    def _wait_until(self, condition: Callable[[], bool], on_wait: Callable[[], None]) -> None:
        """Wait for the condition, which itself waits ``_POLL_S``, as long as frames are finished.

        Waits are counted, not timed: a pause of the process (Ctrl-Z) is one of them.
        """
        seen, waits = self.frames, 0
        while not condition():
            on_wait()
            seen, waits = self.frames, waits + 1 if self.frames == seen else 0
            if waits * _POLL_S > STALL_S:
                raise HungError(f"no frame has been decoded and written for {STALL_S:g} s")

    def finish(self, on_wait: Callable[[], None] = lambda: None) -> None:
        """Process the queue, close the files, and compare their lengths."""
        self._enqueue(None, on_wait)
        self._wait_until(lambda: self._worker.ends_within(_POLL_S), on_wait)
        self._worker.join(END_S)
        if self.video is not None:
            self.video.finish()
            if self.video.written != self._table.rows:
                raise RolloutError(
                    f"{self.video.written} frames were written for {self._table.rows} rows"
                )
        with writing(self._table_path):
            self._table.finish()

    def close(self) -> None:
        """Stop the thread and the writer; the data written so far stays readable."""
        with suppress(BaseException):  # its exception led here
            self._worker.join(END_S)
        if self.video is not None:
            self.video.close()
        self._table.abandon()

    def _serve(self, stop: Event) -> None:
        with torch_threads(1):
            while not stop.is_set():
                try:
                    job = self._jobs.get(timeout=_POLL_S)
                except queue.Empty:
                    continue
                if job is None:
                    return
                self._write(*job, stop)

    def _write(self, segment: Segment, ready: torch.cuda.Event | None, stop: Event) -> None:
        plan = self._plan
        frames = [
            RolloutFrame(
                number=segment.iteration * plan.frames + row,
                iteration=segment.iteration,
                frame=row,
                executed=row < plan.exe_steps,
                step=segment.iteration * plan.exe_steps + row + 1,
                frame_dt_s=self._frame_dt_s,
                state=segment.states[row],
                action=segment.actions[row],
            )
            for row in range(plan.frames)
        ]
        # Rows first: after a crash, rows without a frame are possible, but no frame without a row.
        with writing(self._table_path):
            for frame in frames:
                self._table.add({name: getattr(frame, name) for name in SCHEMA.names})
            self._table.flush()
        missing = [row for row in range(plan.frames) if row not in segment.decoded]
        images = self._decoded(segment.latents, missing, ready)
        for frame in frames:
            if stop.is_set():
                return
            rgb = None
            if self.video is not None:
                rgb = segment.decoded.get(frame.frame)
                if rgb is None:
                    rgb = next(images)
                    self.frames_decoded += 1
                # Frames of the video are evenly spaced.
                captured_ns = round(frame.number * frame.frame_dt_s * NS_PER_S)
                row = FrameRow(
                    frame_id=frame.number,
                    captured_ns=captured_ns,
                    ready_ns=self._clock.now_ns(),
                )
                self.video.submit(rgb, row)
                self._digest.update(np.ascontiguousarray(rgb).data)
            if self._on_frame is not None:
                self._on_frame(frame, rgb)
            self.frames += 1

    def _decoded(
        self, latents: Tensor, rows: list[int], ready: torch.cuda.Event | None
    ) -> Iterator[ImageArray]:
        """Decode rows of latents [N, C, h, w], one at a time: the loop needs the processor, too.

        On a GPU the latents can be read after the event ``ready``.
        """
        if self._stream is not None and ready is not None:
            self._stream.wait_event(ready)
            # Once the loop's stream frees the memory, it must not be reused before this one ends.
            latents.record_stream(self._stream)
        for row in rows:
            beside = nullcontext() if self._stream is None else torch.cuda.stream(self._stream)
            with torch.inference_mode(), beside:
                decoded = self._model.decode(latents[row, None])[0]
                pixels: ImageArray = decoded.cpu().numpy()
            yield pixels
