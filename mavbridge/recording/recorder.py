"""Recorder of a live flight: a ``TickSink`` that works on its own thread.

It cannot hurt the flight. Events wait in bounded queues; when these are full, events are dropped
and counted. An error ends only the recording, with one warning.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from mavbridge.core.observers import ObserverThread
from mavbridge.core.records import Observed, Tick, VisionTick
from mavbridge.core.vehicle import ForwardedPacket
from mavbridge.recording.crash import CrashWatch
from mavbridge.recording.flight_writer import FlightWriter
from mavbridge.recording.folder import FlightMeta
from mavbridge.recording.replay_files import ReplaySettings
from mavbridge.recording.tlog import TlogPipe

CAPACITY = 6000
"""Capacity of the tick queue: one minute at 100 Hz."""
IMAGE_CAPACITY = 32


class Recorder(ObserverThread):
    """Recording of one flight while it flies.

    Call ``close`` once the link is closed; if the link's process is still running, the writer
    process keeps its log to the end.
    """

    def __init__(
        self,
        folder: Path,
        meta: FlightMeta,
        *,
        tlog_pipe: TlogPipe,
        packets_dropped: Callable[[], int],
        autopilot: Callable[[], str],
        report: Callable[[str], None],
        settings: ReplaySettings | None = None,
    ) -> None:
        """Create the files, start the writer process and the thread, which takes seconds.

        ``packets_dropped`` and ``autopilot`` are asked at the end; ``report`` shows a line to the
        user, from the recorder's thread. Without ``settings`` nothing for a replay is kept.

        Raises:
            WriterError: a file cannot be written, or the writer process does not start.
        """
        self._folder = folder
        writer = FlightWriter(
            folder, meta, pressure="online", settings=settings, tlog_pipe=tlog_pipe
        )
        self._flight = _FlightConsumer(writer, packets_dropped, autopilot, report)
        super().__init__(
            "mavbridge-recorder",
            self._flight,
            capacity=CAPACITY,
            image_capacity=IMAGE_CAPACITY,
            cameras=len(meta.contract.cameras),
        )

    def watch_packets(self, packets: tuple[ForwardedPacket, ...]) -> None:
        """Queue the stamps of received packets, or drop and count them. For one thread only."""
        for packet in packets:
            self._flight.writer.packets.put(packet)

    @property
    def dropped(self) -> int:
        """Number of ticks, frames and packets missing from the recording; exact after ``close``."""
        packets = self._flight.packets_dropped() + self._flight.writer.packets.dropped
        return super().dropped + self._flight.frames_lost + packets

    @property
    def loss(self) -> str | None:
        """Why ticks or images are no longer recorded; None if all are. Readable by any thread."""
        failure = self.failure or self._flight.writer.video_failure
        return None if failure is None else str(failure)

    @property
    def crash(self) -> str | None:
        """Description of the crash; None if none was seen. Readable by any thread."""
        return self._flight.crash_watch.reason

    @property
    def meta(self) -> FlightMeta:
        """Contents of ``meta.json``; complete after ``close``."""
        return self._flight.writer.meta

    def describe(self, change: Callable[[FlightMeta], FlightMeta]) -> None:
        """Change ``meta.json`` before ``close``; raise WriterError if it cannot be written."""
        self._flight.writer.describe(change)

    def summary(self) -> str:
        """Return one line for the user: the folder, its contents and the losses."""
        writer = self._flight.writer
        loss = self.loss
        if loss is None and not self.dropped:
            counted = f"{writer.ticks} ticks and {writer.frames_written} frames"
            return f"recorded {counted} in {self._folder}"
        why = f"; {writer.misfit}" if writer.misfit else ", since the machine was too busy"
        lacks = loss or f"{self.dropped} events were dropped{why}"
        return f"recorded in {self._folder}, not completely: {lacks}"


@dataclass
class _FlightConsumer:
    """Consumer on the recorder's thread; can raise WriterError."""

    writer: FlightWriter
    packets_dropped: Callable[[], int]
    autopilot: Callable[[], str]
    report: Callable[[str], None]
    crash_watch: CrashWatch = field(default_factory=CrashWatch)
    _seen_frames: int = 0
    _has_failed: bool = False

    @property
    def frames_lost(self) -> int:
        """Number of frames taken from the queue but missing from the video."""
        return max(0, self._seen_frames - self.writer.frames_written)

    def consume(self, batch: Sequence[Observed]) -> None:
        """Write one batch."""
        seen_frames = self._seen_frames
        try:
            self._note_autopilot(batch[0])
            for event in batch:
                if isinstance(event, Tick):
                    self.crash_watch.see(event)
                    self.writer.tick(event)
                elif isinstance(event, VisionTick):
                    self._write_frame(event)
                else:
                    self.writer.solve(event)
        except BaseException:
            self._has_failed = True
            self._seen_frames = seen_frames  # the observer counts the whole batch as lost
            raise

    def _note_autopilot(self, event: Observed) -> None:
        """Complete ``meta.json`` once the vehicle is known, for a flight that is cut off."""
        meta = self.writer.meta
        if isinstance(event, Tick) and event.mode and (name := self.autopilot()) != meta.autopilot:
            self.writer.describe(lambda meta: replace(meta, autopilot=name))

    def _write_frame(self, vision: VisionTick) -> None:
        self._seen_frames += 1
        told = self.writer.video_failure, self.writer.misfit
        self.writer.frame(vision)
        failure, misfit = self.writer.video_failure, self.writer.misfit
        if misfit not in (None, told[1]):
            self.report(f"images are missing from the recording: {misfit}")
        if failure not in (None, told[0]):
            self.report(f"recording no more images: {failure}; ticks are still recorded")

    def close(self) -> None:
        """Finish in order; after an error, leave the files as they are."""
        if self._has_failed:
            self.writer.close()
            return
        meta, crash = self.writer.meta, self.crash_watch.reason
        self.writer.finish(
            replace(
                meta,
                autopilot=self.autopilot(),
                packets_dropped=self.packets_dropped(),
                success=meta.success if crash is None else False,
                crash=crash,
            )
        )
