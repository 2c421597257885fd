"""A rollout on disk: ``NAME.mp4``, and ``NAME.parquet`` with a row for each of its frames.

While it grows, and after a crash, the table is ``NAME.arrows``, as with recorded flights.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa

from mavbridge.commands.imagine.loop import Segment
from mavbridge.commands.imagine.plan import RolloutPlan
from mavbridge.core.errors import MavbridgeError, UserError
from mavbridge.core.records import RolloutFrame
from mavbridge.recording.folder import require_extra
from mavbridge.recording.tables import TableWriter, read_table
from mavbridge.recording.video.file import count_frames
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
"""frame: within its iteration's segment. executed: the next iteration starts after it, or later.
time_s: since the newest frame that was really seen. action: held until this frame."""


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
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.open("xb").close()
        out.unlink()
    except OSError as error:
        raise UserError(
            f"--out {out} cannot be written ({error.strerror}); name a file in a folder that you "
            "may write to"
        ) from error


def rollout_frames(
    segment: Segment, plan: RolloutPlan, frame_dt_s: float
) -> Iterator[RolloutFrame]:
    """The rows of a segment, without pixels."""
    for row in range(plan.frames):
        yield RolloutFrame(
            number=segment.iteration * plan.frames + row,
            iteration=segment.iteration,
            frame=row,
            executed=row < plan.exe_steps,
            step=segment.iteration * plan.exe_steps + row + 1,
            frame_dt_s=frame_dt_s,
            state=segment.states[row],
            action=segment.actions[row],
        )


class RowsWriter:
    """The table of a rollout, a segment at a time."""

    def __init__(self, out: Path) -> None:
        """Create it.

        Raises:
            RolloutError: it cannot be written.
        """
        self._path = out.with_suffix(".arrows")
        try:
            self._table = TableWriter(out, SCHEMA)
        except OSError as error:
            raise self._failure(error) from error

    @property
    def rows(self) -> int:
        """So far."""
        return self._table.rows

    def append(self, frames: Sequence[RolloutFrame]) -> None:
        """Hand rows to the kernel.

        Raises:
            RolloutError: they cannot be written.
        """
        rows = [
            (f.iteration, f.frame, f.executed, f.time_s, f.state.tolist(), f.action.tolist())
            for f in frames
        ]
        columns = [
            pa.array(column, type=field.type)
            for column, field in zip(zip(*rows, strict=True), SCHEMA, strict=True)
        ]
        try:
            self._table.append(pa.RecordBatch.from_arrays(columns, schema=SCHEMA))
        except OSError as error:
            raise self._failure(error) from error

    def finish(self) -> None:
        """Make Parquet of it.

        Raises:
            RolloutError: it cannot be written; the stream stays.
        """
        try:
            self._table.finish()
        except OSError as error:
            raise self._failure(error) from error

    def abandon(self) -> None:
        """Leave the stream as it is."""
        self._table.abandon()

    def _failure(self, error: OSError) -> RolloutError:
        return RolloutError(f"{self._path} cannot be written: {error.strerror or error}")


def read_rows(out: Path) -> Any:
    """The rows of a rollout's frames, finished or cut off: a ``pyarrow.Table`` of ``SCHEMA``.

    A rollout without a video has its rows alone.

    Raises:
        MavbridgeError: there is none, or it is damaged.
    """
    table = read_table(out, SCHEMA)
    return table.slice(0, count_frames(out)) if out.exists() else table
