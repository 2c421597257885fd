"""Writer of a rollout's segments: ``NAME.mp4``, and ``NAME.parquet`` with a row per frame.

While it grows, and after a crash, the table is ``NAME.arrows``, as with recorded flights. A thread
decodes, the writer process writes.
"""

import hashlib
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from threading import Event

import numpy as np
import pyarrow as pa
import torch
from torch import Tensor

from mavbridge.commands.imagine.loop import (
    RolloutError,
    RolloutPlan,
    Sampler,
    Segment,
)
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.errors import UserError
from mavbridge.core.files import require_writable
from mavbridge.core.records import ImageArray
from mavbridge.core.stopping import HungError
from mavbridge.recording.tables import TableWriter
from mavbridge.recording.video_process import WRITE_ERRORS, VideoJob
from mavbridge.recording.video_writer import VideoWriter
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
"""Columns described in docs/formats.md."""


def prepare_out(out: Path) -> None:
    """Raise UserError if a rollout cannot be written here."""
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
"""Most segments that wait for the decoder; the loop then waits, too, so that the slowest part sets
the pace."""
STALL_S = 120.0
"""Longest time without a finished frame."""
END_S = 45.0
"""Longer than the timeout for a hung writer process."""
_POLL_S = 0.1


class StreamedOutput:
    """Writes frames and rows of segments to disk as they come. Used by the loop's thread.

    Methods other than ``close`` raise ``MavbridgeError`` if writing fails or has failed before.
    """

    def __init__(
        self, out: Path, sampler: Sampler, plan: RolloutPlan, *, decode_video: bool = True
    ) -> None:
        """Open the output at ``out``; without ``decode_video``, only the rows."""
        self.out = out
        self._plan = plan
        self._model = sampler.model
        self._frame_dt_s = sampler.config.frame_dt_s
        self._digest = hashlib.sha256()
        self.frames = 0
        self._stream: torch.cuda.Stream | None = None
        """On a GPU, the decoder's stream beside the sampler's."""
        if (device := next(sampler.model.parameters()).device).type == "cuda":
            self._stream = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]
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
        self._stop = Event()
        self._open: deque[Future[None]] = deque()
        """Segments that are not written yet."""
        self._thread = ThreadPoolExecutor(
            1, "mavbridge-rollout-decode", torch.set_num_threads, (1,)
        )

    @property
    def sha256(self) -> str:
        """SHA-256 of all raw frames so far, in order."""
        return self._digest.hexdigest()

    def put(self, segment: Segment) -> None:
        """Hand over a segment; wait while ``QUEUED_SEGMENTS`` are waiting."""
        ready = None
        if self.video is not None and segment.latents.is_cuda:
            ready = torch.cuda.current_stream(segment.latents.device).record_event()
        self._wait(QUEUED_SEGMENTS)
        self._open.append(self._thread.submit(self._serve, segment, ready))

    def _wait(self, most: int, on_wait: Callable[[], None] = lambda: None) -> None:
        """Wait until at most ``most`` segments are open, as long as frames are finished.

        Waits are counted, not timed: a pause of the process (Ctrl-Z) is one of them.
        """
        seen, waits = self.frames, 0
        while len(self._open) > most:
            on_wait()
            if wait([self._open[0]], _POLL_S).done:
                self._open[0].result()  # raises the thread's exception, also at the next call
                self._open.popleft()
            seen, waits = self.frames, waits + 1 if self.frames == seen else 0
            if waits * _POLL_S > STALL_S:
                raise HungError(f"no frame has been decoded and written for {STALL_S:g} s")

    def finish(self, on_wait: Callable[[], None] = lambda: None) -> None:
        """Write all segments, close the files, and compare their lengths."""
        self._wait(0, on_wait)
        if self.video is not None:
            self.video.finish()
            if self.video.written != self._table.rows:
                raise RolloutError(
                    f"{self.video.written} frames were written for {self._table.rows} rows"
                )
        with writing(self._table_path):
            self._table.finish()

    def close(self) -> None:
        """Stop the thread and the writer, if ``finish`` did not; what is written stays readable."""
        self._stop.set()
        is_hung = bool(wait(self._open, END_S).not_done)
        self._thread.shutdown(wait=not is_hung)
        if self.video is not None:
            self.video.close()
        self._table.abandon()

    def _serve(self, segment: Segment, ready: torch.cuda.Event | None) -> None:
        """Write a segment, whose latents can be read after ``ready``; none after an error."""
        try:
            if not self._stop.is_set():
                self._write(segment, ready)
        except BaseException:
            self._stop.set()
            raise

    def _write(self, segment: Segment, ready: torch.cuda.Event | None) -> None:
        plan, first_step = self._plan, segment.iteration * self._plan.exe_steps + 1
        # Rows first: after a crash, rows without a frame are possible, but no frame without a row.
        with writing(self._table_path):
            for row in range(plan.frames):
                self._table.add(
                    {
                        "iteration": segment.iteration,
                        "frame": row,
                        "executed": row < plan.exe_steps,
                        "time_s": (first_step + row) * self._frame_dt_s,
                        "state": segment.states[row],
                        "action": segment.actions[row],
                    }
                )
            self._table.flush()
        for row in range(plan.frames):
            if self._stop.is_set():
                return
            if self.video is not None:
                rgb = segment.decoded.get(row)
                if rgb is None:
                    rgb = self._decode(segment.latents[row, None], ready)
                number = segment.iteration * plan.frames + row
                # Frames of the video are evenly spaced.
                at_ns = round(number * self._frame_dt_s * NS_PER_S)
                self.video.submit(rgb, at_ns)
                self._digest.update(np.ascontiguousarray(rgb).data)
            self.frames += 1

    def _decode(self, latents: Tensor, ready: torch.cuda.Event | None) -> ImageArray:
        """Decode latents [1, C, h, w]; on a GPU they can be read after the event ``ready``."""
        beside: AbstractContextManager[object] = nullcontext()
        if self._stream is not None and ready is not None:
            self._stream.wait_event(ready)
            # Once the loop's stream frees the memory, it must not be reused before this one ends.
            latents.record_stream(self._stream)
            beside = torch.cuda.stream(self._stream)
        with torch.inference_mode(), beside:
            pixels: ImageArray = self._model.decode(latents)[0].cpu().numpy()
        return pixels
