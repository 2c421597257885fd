"""Single-threaded writer of a flight's folder: ticks, frames and meta."""

from dataclasses import replace
from pathlib import Path

from mavbridge.core.records import Tick, VisionTick
from mavbridge.recording import rows
from mavbridge.recording.folder import TICKS, TLOG, frames_of, video_of
from mavbridge.recording.meta import FlightMeta, write_meta
from mavbridge.recording.rows import FrameRow, FrameTruth, TickLabels, TickRow, ticks_batch
from mavbridge.recording.tables import TableWriter
from mavbridge.recording.tlog import TlogJob, TlogPipe
from mavbridge.recording.video.writer import Pressure, VideoWriter, WriterDiedError, WriterError


class CameraFiles:
    """Frames of one camera, written by a separate process, whose death loses only these."""

    def __init__(
        self,
        folder: Path,
        camera: str | None,
        *,
        pressure: Pressure,
        hz: float,
        with_truth: bool = False,
        tlog: TlogJob | None = None,
    ) -> None:
        """Start the process. ``camera`` is the camera's name, or None for the first one."""
        self.failure: WriterDiedError | None = None
        """Why no more frames are recorded."""
        self.source_size: tuple[int, int] | None = None
        """Height and width of the incoming frames; None before the first."""
        self._serial = -1
        self._video = VideoWriter(
            folder / video_of(camera),
            pressure=pressure,
            hz=hz,
            rows=folder / frames_of(camera),
            with_truth=with_truth,
            tlog=tlog,
        )

    def write(self, vision: VisionTick, truth: FrameTruth | None) -> None:
        """Record a frame. Skipped serial numbers count as dropped."""
        dropped = vision.serial - self._serial - 1
        self._serial = vision.serial
        if self.failure is not None:
            return
        if self.source_size is None:
            self.source_size = (vision.rgb.shape[0], vision.rgb.shape[1])
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
            self.failure = error

    @property
    def written(self) -> int:
        """Frames known to be in the video."""
        return self._video.written

    @property
    def dropped(self) -> int:
        """Number of frames missing from the video, up to the newest one."""
        return self._serial + 1 - self._video.written

    @property
    def size(self) -> tuple[int, int] | None:
        """Height and width of the video; None before the first frame."""
        return self._video.size

    def finish(self) -> None:
        """Close the files in order if the process is alive."""
        if self.failure is not None:
            return
        try:
            self._video.finish()
        except WriterDiedError as error:
            self.failure = error

    def close(self) -> None:
        """Leave the files as they are. Can be called twice."""
        self._video.close()


FLUSH_NS = 500_000_000
"""Longest span of events that a crash can lose."""
FLUSH_ROWS = 256


class FlightWriter:
    """Writer used during the flight; ``finish`` closes the files in order.

    Methods raise OSError or WriterError if a file cannot be written. Afterwards only ``finish`` and
    ``close`` are allowed; everything written before stays readable.
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
            pressure: "offline" waits and drops nothing; see ``VideoWriter``.
            with_labels: the tables have the columns of ``TickLabels`` and ``FrameTruth``.
            tlog_pipe: its reader becomes ``link.tlog`` and is closed here; None: no such file.
        """
        self._folder = folder
        self.meta = meta
        self._schema = rows.DEMONSTRATION_TICKS if with_labels else rows.TICKS
        self._rows: list[TickRow] = []
        self._flushed_ns = meta.start_ns
        self._tick_serial = -1
        self._ticks_dropped = 0
        names = (None,) if meta.contract is None else (None, *meta.contract.cameras[1:])
        job = None if tlog_pipe is None else TlogJob(folder / TLOG, tlog_pipe.reader)
        self.cameras: list[CameraFiles] = []
        """Cameras in the contract's order."""
        try:
            for camera in names:
                self.cameras.append(
                    CameraFiles(
                        folder,
                        camera,
                        pressure=pressure,
                        hz=meta.visual_hz,
                        with_truth=with_labels,
                        tlog=job if camera is None else None,
                    )
                )
            write_meta(folder, meta)
            self._table = TableWriter(folder / TICKS, self._schema)
            # Import the modules of the first conversion now, not in flight.
            self._table.append(ticks_batch([], self._schema))
        except (OSError, WriterError):
            self._close_cameras()
            raise

    def tick(self, tick: Tick, labels: TickLabels | None = None) -> None:
        """Record a tick. Skipped serial numbers count as dropped."""
        dropped = tick.serial - self._tick_serial - 1
        self._tick_serial = tick.serial
        self._ticks_dropped += dropped
        self._rows.append(TickRow(tick, dropped, labels))
        if len(self._rows) >= FLUSH_ROWS:
            self._flush()
        self._flush_if_due(tick.woke_ns)

    def frame(self, vision: VisionTick, truth: FrameTruth | None = None) -> None:
        """Record a frame of any camera. Skipped serial numbers count as dropped.

        If a writer process dies, only its frames are lost: see ``video_failure``.
        """
        self._flush_if_due(vision.ready_ns)
        self.cameras[vision.camera].write(vision, truth)

    @property
    def video_failure(self) -> WriterDiedError | None:
        """Return why frames of a camera are no longer recorded while the rest is, or None."""
        failures = (files.failure for files in self.cameras)
        return next((failure for failure in failures if failure is not None), None)

    def _flush_if_due(self, now_ns: int) -> None:
        if now_ns - self._flushed_ns >= FLUSH_NS:
            self._flushed_ns = now_ns
            self._flush()

    def _flush(self) -> None:
        if self._rows:
            # Clear first, so that rows that could not be written are not retried.
            waiting, self._rows = self._rows, []
            self._table.append(ticks_batch(waiting, self._schema))

    @property
    def frames_written(self) -> int:
        """Number of frames known to be in the videos."""
        return sum(files.written for files in self.cameras)

    @property
    def ticks(self) -> int:
        """Number of rows so far."""
        return self._table.rows + len(self._rows)

    def finish(self, meta: FlightMeta) -> None:
        """Close everything in order, and complete ``meta`` with the counts kept here.

        If a writer has died, its table stays as it was and ``finished`` stays false.
        """
        try:
            self._flush()
            self._table.finish()
            for files in self.cameras:
                files.finish()
        except BaseException:
            self.close()
            raise
        is_whole = self.video_failure is None
        first = self.cameras[0]
        height, width = first.size or (None, None)
        source_height, source_width = first.source_size or (None, None)
        self.meta = replace(
            meta,
            image_height=height,
            image_width=width,
            source_height=source_height,
            source_width=source_width,
            finished=is_whole,
            ticks=self._table.rows,
            frames=first.written if is_whole else None,
            ticks_dropped=self._ticks_dropped,
            frames_dropped=first.dropped,
        )
        write_meta(self._folder, self.meta)

    def close(self) -> None:
        """Leave everything as it is, after an error. Can be called twice."""
        self._close_cameras()
        self._table.abandon()

    def _close_cameras(self) -> None:
        for files in self.cameras:
            files.close()
