"""A video and the table of its frames, written together."""

from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from mavbridge.core.records import CameraImage
from mavbridge.recording.rows import DEMONSTRATION_FRAMES, FRAMES, FrameRow, frames_batch
from mavbridge.recording.tables import READ_ERRORS, TableWriter
from mavbridge.recording.video.file import WRITE_ERRORS, FragmentedMp4

FILE_ERRORS = (*WRITE_ERRORS, *READ_ERRORS)
FLUSH_NS = 500_000_000
"""Longest span of frames whose rows may wait."""
FLUSH_ROWS = 64


class VideoJob(NamedTuple):
    """Files to write."""

    video: Path
    """Fragmented MP4; must not exist."""
    hz: float
    rows: Path | None = None
    """Path and stem of the frames table; None: only a video."""
    with_truth: bool = False


class FrameFiles:
    """The files of one job; made with the first frame, whose size is that of the video.

    Every method may raise one of ``FILE_ERRORS``: then ``abandon`` is all that may follow.
    """

    def __init__(self, job: VideoJob) -> None:
        self._job = job
        self._video: FragmentedMp4 | None = None
        self._table: TableWriter | None = None
        self._rows: list[FrameRow] = []

    def append(self, rgb: CameraImage, row: FrameRow) -> None:
        """Write a frame with even sides; its row follows within half a second."""
        if self._video is None:
            height, width = rgb.shape[:2]
            job = self._job
            self._video = FragmentedMp4(
                job.video, height=height, width=width, hz=job.hz, is_depth=rgb.ndim == 2
            )
        self._video.append(rgb, row.captured_ns)
        if self._job.rows is not None:
            self._rows.append(row)
            is_due = row.captured_ns - self._rows[0].captured_ns >= FLUSH_NS
            if is_due or len(self._rows) >= FLUSH_ROWS:
                self.flush()

    def flush(self) -> None:
        """Write the rows that wait."""
        if self._job.rows is None or not self._rows:
            return
        schema = DEMONSTRATION_FRAMES if self._job.with_truth else FRAMES
        if self._table is None:
            self._table = TableWriter(self._job.rows, schema)
        rows, self._rows = self._rows, []
        self._table.append(frames_batch(rows, schema))

    def finish(self) -> None:
        """Close both files in order."""
        self._close_video()
        self.flush()
        if self._table is not None:
            table, self._table = self._table, None
            table.finish()

    def abandon(self) -> None:
        """Leave what is written; the file that failed may be cut off at its end. Never raises."""
        for close in (self._close_video, self.flush):
            with suppress(*FILE_ERRORS):  # a disk that was full still is
                close()
        if self._table is not None:
            self._table.abandon()

    def _close_video(self) -> None:
        if self._video is not None:
            video, self._video = self._video, None
            video.close()
