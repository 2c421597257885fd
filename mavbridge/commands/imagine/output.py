"""Writes a rollout's segments: ``NAME.mp4``, and ``NAME.parquet`` with a row for each frame.

While it grows, and after a crash, the table is ``NAME.arrows``, as with recorded flights.
"""

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa

from mavbridge.commands.imagine.loop import RolloutPlan, Segment
from mavbridge.commands.imagine.sampling import Sampler
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.errors import MavbridgeError, UserError
from mavbridge.core.files import require_writable
from mavbridge.core.records import ImageArray, RolloutFrame
from mavbridge.recording.folder import require_extra
from mavbridge.recording.tables import TableWriter, read_table
from mavbridge.recording.video.file import WRITE_ERRORS, FragmentedMp4, count_frames
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
"""The columns of docs/formats/rollout_files.md, named as the attributes of ``RolloutFrame``."""

OnFrame: TypeAlias = Callable[[RolloutFrame, ImageArray | None], None]
"""Called for every frame [H, W, 3] in the video's order, by one thread; None: not decoded."""


def ignore_frame(frame: RolloutFrame, rgb: ImageArray | None) -> None:
    """An ``OnFrame`` that does nothing."""


class RolloutError(MavbridgeError):
    """A rollout that could not be written to its end; what was written is readable."""


def prepare_out(out: Path) -> None:
    """Make sure that a rollout can be written here.

    Raises:
        UserError: the extra is not installed, the name is taken or no .mp4, or may not be written.
    """
    require_extra("imagine")
    if out.suffix != ".mp4":
        raise UserError(f"--out {out} must end in .mp4")
    for path in (out, out.with_suffix(".arrows"), out.with_suffix(".parquet")):
        if path.exists():
            raise UserError(f"{path} is there already: remove it, or name another --out")
    require_writable(out, "--out")


def read_rows(out: Path) -> Any:
    """The rows of a rollout's frames, finished or cut off: a ``pyarrow.Table`` of ``SCHEMA``.

    A rollout without a video has its rows alone.

    Raises:
        MavbridgeError: there is none, or it is damaged.
    """
    table = read_table(out, SCHEMA)
    return table.slice(0, count_frames(out)) if out.exists() else table


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn the errors of writing a file into ``RolloutError``."""
    try:
        yield
    except WRITE_ERRORS as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise RolloutError(f"{path} cannot be written: {reason}") from error


def rows_batch(frames: Sequence[RolloutFrame]) -> pa.RecordBatch:
    """Rows of the table."""
    rows = [{name: getattr(frame, name) for name in SCHEMA.names} for frame in frames]
    return pa.RecordBatch.from_pylist(rows, schema=SCHEMA)


def captured_ns(frame: RolloutFrame) -> int:
    """Time of a frame in the video, where the frames follow each other evenly."""
    return round(frame.number * frame.frame_dt_s * NS_PER_S)


class RolloutOutput(ABC):
    """Takes segments; used by the loop's thread.

    Methods raise ``MavbridgeError`` if something, now or before, could not be written.
    """

    def __init__(
        self,
        out: Path,
        sampler: Sampler,
        plan: RolloutPlan,
        *,
        decode_video: bool = True,
        on_frame: OnFrame = ignore_frame,
    ) -> None:
        """Open the output at ``out``; without ``decode_video`` it is the rows alone."""
        self.out = out
        self._plan = plan
        self._decode_video = decode_video
        self._clock = sampler.clock
        self._sampler = sampler
        self._frame_dt_s = sampler.config.frame_dt_s
        self._on_frame = on_frame
        self._digest = hashlib.sha256()
        self.frames = 0
        self.frames_decoded = 0
        """Frames decoded beside the loop's thread, whose own are in its meter."""
        self._open()

    @property
    def sha256(self) -> str:
        """SHA-256 of all frames so far, raw, in their order."""
        return self._digest.hexdigest()

    @property
    def decode_queue(self) -> int:
        """Segments that wait to be decoded."""
        return 0

    @property
    @abstractmethod
    def writer_queue(self) -> int:
        """Frames that wait to be written."""

    @property
    def writer_pid(self) -> int | None:
        """Process id of the writer; None where there is none."""
        return None

    @abstractmethod
    def _open(self) -> None:
        """Create what can be created before the first segment."""

    @abstractmethod
    def put(self, segment: Segment) -> None:
        """Take the next segment; may block."""

    @abstractmethod
    def finish(self, on_wait: Callable[[], None] = lambda: None) -> None:
        """Write everything and close the files; ``on_wait`` is called now and then meanwhile."""

    @abstractmethod
    def close(self) -> None:
        """Leave things as they are, after an error; may be called twice."""

    def _rows(self, segment: Segment) -> list[RolloutFrame]:
        plan = self._plan
        return [
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

    def _show(self, frame: RolloutFrame, rgb: ImageArray | None) -> None:
        """Count a frame that has left the decoder, and let the observer see it."""
        if rgb is not None:
            self._digest.update(np.ascontiguousarray(rgb).data)
        self._on_frame(frame, rgb)
        self.frames += 1


class SerialOutput(RolloutOutput):
    """The plain form, kept as the reference: all frames in a list, everything written at the end.

    Every frame must have been decoded by the loop.
    """

    def _open(self) -> None:
        self._collected: list[tuple[RolloutFrame, ImageArray]] = []
        self._written = 0

    @property
    def writer_queue(self) -> int:
        """Frames that wait to be written."""
        return len(self._collected) - self._written

    def put(self, segment: Segment) -> None:
        """Keep a segment."""
        for frame in self._rows(segment):
            rgb = segment.decoded[frame.frame]
            self._collected.append((frame, rgb))
            self._show(frame, rgb if self._decode_video else None)

    def finish(self, on_wait: Callable[[], None] = lambda: None) -> None:
        """Write everything."""
        with self._sampler.meter.write, writing(self.out):
            table = TableWriter(self.out, SCHEMA)
            try:
                table.append(rows_batch([frame for frame, _ in self._collected]))
                if self._decode_video:
                    size = self._sampler.config.image_size
                    with closing(
                        FragmentedMp4(self.out, height=size, width=size, hz=1 / self._frame_dt_s)
                    ) as video:
                        for frame, rgb in self._collected:
                            video.append(rgb, captured_ns(frame))
                            self._written += 1
                            on_wait()
            except BaseException:
                table.abandon()
                raise
            table.finish()

    def close(self) -> None:
        """Nothing is open between two calls."""
