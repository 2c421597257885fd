"""Single-threaded writer of a flight's folder: tables, videos and meta."""

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import pyarrow as pa

from mavbridge.core.observers import BoundedQueue
from mavbridge.core.records import Solve, Tick, VisionTick
from mavbridge.core.vehicle import Action, ForwardedPacket
from mavbridge.recording import replay_files
from mavbridge.recording.folder import FlightMeta, write_meta
from mavbridge.recording.replay_files import ReplaySettings
from mavbridge.recording.rows import (
    DEMONSTRATION_FRAMES,
    DEMONSTRATION_TICKS,
    FrameRow,
    FrameTruth,
    TickRow,
    frame_columns,
    tick_columns,
)
from mavbridge.recording.tables import FLUSH_NS, TableWriter
from mavbridge.recording.tlog import TlogPipe
from mavbridge.recording.video_process import VideoJob
from mavbridge.recording.video_writer import Pressure, VideoWriter, WriterDiedError, WriterError
from policy.data.flight_files import FEATURES, FRAMES, PACKETS, SOLVES, TICKS, of_camera, video_of
from policy.data.tables import FRAME_COLUMNS, TICK_COLUMNS

PACKET_CAPACITY = 60_000
"""Capacity of the queue of packet stamps: one minute of the busiest link."""


class SerialNumbers:
    """Consecutive numbers, some of which are missing."""

    def __init__(self, first: int = 0) -> None:
        self.next = first
        self.dropped = 0

    def take(self, serial: int) -> int:
        """Return how many numbers were skipped before this one."""
        skipped, self.next = serial - self.next, serial + 1
        self.dropped += skipped
        return skipped


@dataclass
class _Camera:
    """Files of one camera."""

    name: str | None
    """Name in file names; None for the first camera."""
    video: VideoWriter
    features: TableWriter | None = None
    frames: TableWriter | None = None
    """Created with the first frame."""
    serials: SerialNumbers = field(default_factory=SerialNumbers)
    recorded: SerialNumbers = field(default_factory=SerialNumbers)
    """Of all frames, and of those that the video has."""
    is_dead: bool = False
    """True if the writer process has died: its frames are lost."""


class FlightWriter:
    """Writer used during the flight; ``finish`` closes the files in order.

    Methods raise WriterError if a file cannot be written. Afterwards only ``finish`` and
    ``close`` are allowed; everything written before stays readable.
    """

    def __init__(
        self,
        folder: Path,
        meta: FlightMeta,
        *,
        pressure: Pressure,
        with_labels: bool = False,
        settings: ReplaySettings | None = None,
        tlog_pipe: TlogPipe | None = None,
    ) -> None:
        """Create the files in a folder from ``prepare_folder``, and start the writer process.

        ``with_labels`` adds columns for the expert and ``FrameTruth``, ``settings`` the files for a
        replay. The reader of ``tlog_pipe`` becomes ``link.tlog`` and is closed here.
        """
        self._folder = folder
        self.meta, self._meta_lock = meta, threading.Lock()
        self._flushed_ns = meta.start_ns
        self._serials, self._solve_serials = SerialNumbers(), SerialNumbers(first=1)
        self._tables: list[TableWriter] = []
        self._cameras: list[_Camera] = []
        """In the contract's order."""
        self.video_failure: WriterDiedError | None = None
        """Why frames of a camera are no longer recorded while the rest is."""
        self.packets: BoundedQueue[ForwardedPacket] = BoundedQueue(PACKET_CAPACITY)
        """Packets in order of arrival; filled by another thread."""
        self._packet_serials, self._packets_dropped = SerialNumbers(), 0
        try:
            with self._writing():
                self._start_videos(pressure, tlog_pipe)
                write_meta(folder, meta)
                if settings is not None:
                    replay_files.write_settings(folder, settings)
                self._open_tables(with_labels=with_labels, with_replay=settings is not None)
        except WriterError:
            self.close()
            raise

    def _start_videos(self, pressure: Pressure, tlog_pipe: TlogPipe | None) -> None:
        tlog = None if tlog_pipe is None else tlog_pipe.reader
        for name in (None, *self.meta.contract.cameras[1:]):
            of_first = tlog if name is None else None
            job = VideoJob(self._folder / video_of(name), self.meta.visual_hz, of_first)
            self._cameras.append(_Camera(name, VideoWriter(job, pressure=pressure)))

    def _open_tables(self, *, with_labels: bool, with_replay: bool) -> None:
        self._ticks = self._table(TICKS, DEMONSTRATION_TICKS if with_labels else TICK_COLUMNS)
        self._frames_schema = DEMONSTRATION_FRAMES if with_labels else FRAME_COLUMNS
        self._solves = self._table(SOLVES, replay_files.SOLVES) if with_replay else None
        self._packets = self._table(PACKETS, replay_files.PACKETS) if with_replay else None
        if with_replay and self.meta.mode == "dual":  # else features are only resized images
            for camera in self._cameras:
                camera.features = self._table(
                    of_camera(FEATURES, camera.name), replay_files.FEATURES
                )

    def _table(self, stem: str, schema: pa.Schema) -> TableWriter:
        table = TableWriter(self._folder / stem, schema)
        self._tables.append(table)
        return table

    def tick(self, tick: Tick, expert: Action | None = None) -> None:
        """Record a tick. Skipped serial numbers count as dropped."""
        self._ticks.add(tick_columns(TickRow(tick, self._serials.take(tick.serial), expert)))
        self._flush_if_due(tick.woke_ns)

    def frame(self, vision: VisionTick, truth: FrameTruth | None = None) -> None:
        """Record a frame of any camera, and its feature. Skipped serial numbers count as dropped.

        If a writer process dies, only its frames are lost: see ``video_failure``.
        """
        camera = self._cameras[vision.camera]
        dropped = camera.serials.take(vision.serial)
        if camera.features is not None and vision.feature is not None:
            camera.features.add(replay_files.feature_columns(vision, vision.feature, dropped))
        self._flush_if_due(vision.ready_ns)
        if not self._act(camera, lambda video: video.submit(vision.rgb, vision.captured_ns)):
            return
        if camera.frames is None:
            with self._writing():
                camera.frames = self._table(of_camera(FRAMES, camera.name), self._frames_schema)
        row = FrameRow(
            frame_id=vision.frame_id,
            captured_ns=vision.captured_ns,
            ready_ns=vision.ready_ns,
            dropped_before=camera.recorded.take(vision.serial),
            truth=truth,
        )
        camera.frames.add(frame_columns(row))

    def _act(self, camera: _Camera, act: Callable[[VideoWriter], bool | None]) -> bool | None:
        """Use the writer of a camera; its death, which loses only its frames, returns None."""
        if not camera.is_dead:
            try:
                return act(camera.video)
            except WriterDiedError as error:
                camera.is_dead = True
                self.video_failure = self.video_failure or error
        return None

    def solve(self, solve: Solve) -> None:
        """Record a solve for a replay. Skipped serial numbers count as dropped."""
        if self._solves is not None:
            self._solves.add(
                replay_files.solve_columns(solve, self._solve_serials.take(solve.serial))
            )
            self._flush_if_due(solve.computed_ns)

    def _flush_if_due(self, now_ns: int) -> None:
        if now_ns - self._flushed_ns >= FLUSH_NS:
            self._flushed_ns = now_ns
            self.flush()

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Context manager: raise WriterError for an OSError."""
        try:
            yield
        except OSError as error:
            reason = os.strerror(error.errno) if error.errno else error
            raise WriterError(f"{self._folder} cannot be written: {reason}") from error

    def flush(self) -> None:
        """Hand all rows to the kernel."""
        if self._packets is not None:
            for packet in self.packets.take():
                skipped = self._packet_serials.take(self._packets.rows + self._packets_dropped)
                self._packets.add(replay_files.packet_columns(packet, skipped))
            self._packets_dropped = self.packets.dropped  # behind those: the queue was full
        with self._writing():
            for table in self._tables:
                table.flush()

    def describe(self, change: Callable[[FlightMeta], FlightMeta]) -> None:
        """Change ``meta.json``. Thread-safe."""
        with self._meta_lock, self._writing():
            self.meta = change(self.meta)
            write_meta(self._folder, self.meta)

    @property
    def misfit(self) -> str | None:
        """Why a frame was dropped that its video cannot have; None if there was none."""
        misfits = (camera.video.misfit for camera in self._cameras)
        return next((misfit for misfit in misfits if misfit), None)

    @property
    def frames_written(self) -> int:
        """Number of frames known to be in the videos."""
        return sum(camera.video.written for camera in self._cameras)

    @property
    def ticks(self) -> int:
        """Number of rows so far."""
        return self._ticks.rows

    def finish(self, meta: FlightMeta) -> None:
        """Close everything in order, and complete ``meta`` with the counts kept here.

        If a writer has died, its video stays as it was and ``finished`` stays false.
        """
        try:
            self.flush()
            with self._writing():
                for table in self._tables:
                    table.finish()
            for camera in self._cameras:
                self._act(camera, lambda video: video.finish())
        except BaseException:
            self.close()
            raise
        is_whole = self.video_failure is None
        written = [each.video.written for each in self._cameras]
        self.describe(
            lambda _: replace(
                meta,
                finished=is_whole,
                ticks=self._ticks.rows,
                frames=written[0] if is_whole else None,
                ticks_dropped=self._serials.dropped,
                frames_dropped=sum(each.serials.next for each in self._cameras) - sum(written),
            )
        )

    def close(self) -> None:
        """Leave everything as it is, after an error. Can be called twice."""
        for camera in self._cameras:
            camera.video.close()
        for table in self._tables:
            table.abandon()
