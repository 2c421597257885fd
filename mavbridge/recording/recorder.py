"""Recorder of a live flight, a ``TickSink`` that works on its own thread, and its crash detector.

It cannot hurt the flight. Events wait in bounded queues; when these are full, events are dropped
and counted. An error ends only the recording, with one warning.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.observers import ObserverThread
from mavbridge.core.reasons import Code, because
from mavbridge.core.records import Observed, Tick, VisionTick
from mavbridge.core.rotation import tilt_rad
from mavbridge.core.vehicle import ForwardedPacket, VehicleText, recorded_text
from mavbridge.recording.flight_writer import FlightWriter
from mavbridge.recording.folder import FlightMeta
from mavbridge.recording.replay_files import ReplaySettings, write_settings
from mavbridge.recording.tlog import TlogPipe
from policy.contract import QUATERNION

CAPACITY = 6000
"""Capacity of the tick queue: one minute at 100 Hz."""
IMAGE_CAPACITY = 32
OVERTURNED_NS = 500 * NS_PER_MS
"""Shortest time armed beyond 90 degrees of tilt that counts as a crash; a flip takes less."""
FALL_NS = NS_PER_S
"""Window after a disarming for a fall, which reaches 9.8 m/s in 1 s, and for a late crash message.
Later ones are the checks before the next arming, such as "PreArm: CrashDump data detected"."""
FALL_MPS = 1.5
"""Speed while disarmed that counts as a fall; a vehicle at rest reports less, any fall more."""
_WORDS = ("crash", "flight termination", "lockdown")
"""Words in the crash messages of ArduPilot ("Crash: Disarming") and PX4 ("Flight termination
active", "Lockdown")."""
_PILOTS = because(Code.PILOT_FLIES)
"""Reason of every tick in a pilot's recording."""


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
        """Create the files, start the writer process and the thread; raise OSError, WriterError.

        ``packets_dropped`` and ``autopilot`` are asked at the end; ``report`` shows a line to the
        user, from the recorder's thread. Without ``settings`` the flight cannot be replayed.
        """
        self._folder = folder
        writer = FlightWriter(
            folder, meta, pressure="online", with_replay=True, tlog_pipe=tlog_pipe
        )
        if settings is not None:
            try:
                write_settings(folder, settings)
            except OSError:
                writer.close()
                raise
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


class CrashWatch:
    """Crash detector. It takes the ticks of a flight in order; ``reason`` is the first crash.

    A fall counts if the policy had control when the vehicle was last armed, or in a pilot's
    recording; a pilot who has taken over may disarm in the air.
    """

    def __init__(self) -> None:
        self.reason: str | None = None
        self._over_since_ns: int | None = None
        self._was_armed = self._counts_falls = False
        self._disarmed_ns = 0

    def see(self, tick: Tick) -> None:
        """Process one tick."""
        if tick.armed:  # the guard releases in the pass in which it sees a disarming
            is_ours = tick.phase in (None, "flying", "leaving")
            self._counts_falls = is_ours or tick.release_reason == _PILOTS
        was_armed, self._was_armed = self._was_armed, tick.armed
        if was_armed and not tick.armed:
            self._disarmed_ns = tick.woke_ns
        is_soon = tick.woke_ns - self._disarmed_ns <= FALL_NS
        may_fall = self._counts_falls and is_soon
        if self.reason is None and (tick.armed or was_armed or may_fall):
            self.reason = self._said(tick) or self._overturned(tick)
            if may_fall:
                self.reason = self.reason or self._fallen(tick)

    def _said(self, tick: Tick) -> str | None:
        for text in map(recorded_text, tick.texts):
            if isinstance(text, VehicleText) and any(word in text.lower() for word in _WORDS):
                return f"the vehicle said {text.said!r}"
        return None

    def _overturned(self, tick: Tick) -> str | None:
        if (
            tick.state is None
            or not tick.armed
            or tilt_rad(tick.state.values[QUATERNION].tolist()) <= math.pi / 2
        ):
            self._over_since_ns = None
            return None
        if self._over_since_ns is None:
            self._over_since_ns = tick.woke_ns
        is_long = tick.woke_ns - self._over_since_ns >= OVERTURNED_NS
        return "it lay on its back while armed" if is_long else None

    def _fallen(self, tick: Tick) -> str | None:
        if tick.armed or tick.state is None or tick.state.speed_mps < FALL_MPS:
            return None
        return f"it was disarmed in the air, and moved at {tick.state.speed_mps:.1f} m/s"


@dataclass
class _FlightConsumer:
    """Consumer on the recorder's thread; can raise OSError and WriterError."""

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

    def _write_frame(self, vision: VisionTick) -> None:
        self._seen_frames += 1
        told = self.writer.video_failure, self.writer.misfit
        self.writer.frame(vision)
        failure, misfit = self.writer.video_failure, self.writer.misfit
        if misfit not in (None, told[1]):
            self.report(f"images are missing from the recording: {misfit}")
        if failure not in (None, told[0]):
            self.report(f"recording no more images: {failure}; the rest is still recorded")

    def close(self) -> None:
        """Finish in order; after an error, leave the files as they are."""
        if self._has_failed:
            self.writer.close()
            return
        crash = self.crash_watch.reason
        self.writer.finish(
            replace(
                self.writer.meta,
                autopilot=self.autopilot(),
                packets_dropped=self.packets_dropped(),
                success=None if crash is None else False,
                crash=crash,
            )
        )
