"""One flight into its folder, by one thread: ticks, frames, and meta around them."""

from dataclasses import replace
from pathlib import Path

from mavbridge.core.records import Tick, VisionTick
from mavbridge.recording import rows
from mavbridge.recording.folder import FRAMES, TICKS, TLOG, VIDEO
from mavbridge.recording.meta import FlightMeta, write_meta
from mavbridge.recording.rows import FrameRow, FrameTruth, TickLabels, TickRow, ticks_batch
from mavbridge.recording.tables import TableWriter
from mavbridge.recording.tlog import TlogJob, TlogPipe
from mavbridge.recording.video.writer import Pressure, VideoWriter, WriterDiedError

FLUSH_NS = 500_000_000
"""Longest span of events that a crash may take with it."""
FLUSH_ROWS = 256


class FlightWriter:
    """Writes during the flight; ``finish`` closes it in order.

    Methods raise OSError or WriterError where it cannot be written. After that only ``finish`` and
    ``close`` may follow; what was written before stays readable.
    """

    def __init__(
        self,
        folder: Path,
        meta: FlightMeta,
        *,
        pressure: Pressure,
        with_labels: bool = False,
        tlog_pipe: TlogPipe | None = None,
    ) -> None:
        """Create the files in a folder from ``prepare_folder``, and start the writer process.

        Args:
            folder: the flight's folder.
            meta: the facts known at the start.
            pressure: "offline" drops nothing, and waits; see ``VideoWriter``.
            with_labels: the tables have the columns of ``TickLabels`` and ``FrameTruth``.
            tlog_pipe: its reader becomes ``link.tlog``, and is closed here; None = no such file.
        """
        self._folder = folder
        self.meta = meta
        self.video_failure: WriterDiedError | None = None
        """Reason why no more frames are recorded, while the rest is."""
        self._schema = rows.DEMONSTRATION_TICKS if with_labels else rows.TICKS
        self._rows: list[TickRow] = []
        self._flushed_ns = meta.start_ns
        self._tick_serial = self._frame_serial = -1
        self._ticks_dropped = 0
        self._source_size: tuple[int, int] | None = None
        self._video = VideoWriter(
            folder / VIDEO,
            pressure=pressure,
            hz=meta.visual_hz,
            rows=folder / FRAMES,
            with_truth=with_labels,
            tlog=None if tlog_pipe is None else TlogJob(folder / TLOG, tlog_pipe.reader),
        )
        try:
            write_meta(folder, meta)
            self._table = TableWriter(folder / TICKS, self._schema)
            # The first conversion imports modules: now, and not in flight.
            self._table.append(ticks_batch([], self._schema))
        except OSError:
            self._video.close()
            raise

    def tick(self, tick: Tick, labels: TickLabels | None = None) -> None:
        """Record a tick; serial numbers that were left out count as dropped."""
        dropped = tick.serial - self._tick_serial - 1
        self._tick_serial = tick.serial
        self._ticks_dropped += dropped
        self._rows.append(TickRow(tick, dropped, labels))
        if len(self._rows) >= FLUSH_ROWS:
            self._flush()
        self._flush_if_due(tick.woke_ns)

    def frame(self, vision: VisionTick, truth: FrameTruth | None = None) -> None:
        """Record a frame; serial numbers that were left out count as dropped.

        A writer process that died costs the frames alone: see ``video_failure``.
        """
        self._flush_if_due(vision.ready_ns)
        dropped = vision.serial - self._frame_serial - 1
        self._frame_serial = vision.serial
        if self.video_failure is not None:
            return
        if self._source_size is None:
            self._source_size = (vision.rgb.shape[0], vision.rgb.shape[1])
        row = FrameRow(
            frame_id=vision.frame_id,
            captured_ns=vision.captured_ns,
            ready_ns=vision.ready_ns,
            dropped_before=dropped,
            truth=truth,
        )
        try:
            self._video.submit(vision.rgb, row)
        except WriterDiedError as error:
            self.video_failure = error

    def _flush_if_due(self, now_ns: int) -> None:
        if now_ns - self._flushed_ns >= FLUSH_NS:
            self._flushed_ns = now_ns
            self._flush()

    def _flush(self) -> None:
        if self._rows:
            # Cleared first: rows that could not be written are not tried again.
            waiting, self._rows = self._rows, []
            self._table.append(ticks_batch(waiting, self._schema))

    @property
    def frames_written(self) -> int:
        """Frames known to be in the video."""
        return self._video.written

    @property
    def ticks(self) -> int:
        """Rows so far."""
        return self._table.rows + len(self._rows)

    def finish(self, meta: FlightMeta) -> None:
        """Close everything in order; ``meta`` is completed with what was counted here.

        A writer that died leaves its table as it was, and ``finished`` false.
        """
        try:
            self._flush()
            self._table.finish()
            if self.video_failure is None:
                try:
                    self._video.finish()
                except WriterDiedError as error:
                    self.video_failure = error
        except BaseException:
            self.close()
            raise
        is_whole = self.video_failure is None
        height, width = self._video.size or (None, None)
        source_height, source_width = self._source_size or (None, None)
        self.meta = replace(
            meta,
            image_height=height,
            image_width=width,
            source_height=source_height,
            source_width=source_width,
            finished=is_whole,
            ticks=self._table.rows,
            frames=self._video.written if is_whole else None,
            ticks_dropped=self._ticks_dropped,
            frames_dropped=self._frame_serial + 1 - self._video.written,
        )
        write_meta(self._folder, self.meta)

    def close(self) -> None:
        """Leave everything as it is, after an error; may be called twice."""
        self._video.close()
        self._table.abandon()
