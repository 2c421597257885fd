"""The episodes of one recording session: a folder each, its recorder, and its mark."""

import os
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from mavbridge.commands.record.control import Mark
from mavbridge.core.clock import NS_PER_S, Clock
from mavbridge.core.errors import UserError
from mavbridge.core.records import Event, Tick
from mavbridge.mavlink.transport.packet_pipe import PacketPipe
from mavbridge.recording.folder import META, prepare_folder
from mavbridge.recording.meta import FlightMeta, write_meta
from mavbridge.recording.recorder import Recorder
from mavbridge.recording.tlog import open_tlog_pipe

PREFIX = "episode-"
CLOSE_S = 60.0
"""The tables of a long episode become Parquet within seconds."""


class _Recording:
    """The episode that is being recorded; ticks come from one thread, frames from another."""

    def __init__(
        self, folder: Path, number: int, begin_ns: int, log: PacketPipe, recorder: Recorder
    ) -> None:
        self.folder = folder
        self.number = number
        self.begin_ns = begin_ns
        self.log = log
        self.recorder = recorder
        self.mark: Mark | None = None
        self._first_tick: int | None = None
        self._first_frame: int | None = None

    def emit(self, event: Event) -> None:
        """Record what happened since the begin, numbered from there."""
        if isinstance(event, Tick):
            if event.woke_ns >= self.begin_ns:
                self._first_tick = event.serial if self._first_tick is None else self._first_tick
                self.recorder.emit(replace(event, serial=event.serial - self._first_tick))
        elif event.captured_ns >= self.begin_ns:
            self._first_frame = event.serial if self._first_frame is None else self._first_frame
            self.recorder.emit(replace(event, serial=event.serial - self._first_frame))


class Finished(NamedTuple):
    """An episode on disk."""

    folder: Path
    number: int
    meta: FlightMeta


class Episodes:
    """Begins, ends and marks episodes; all but ``emit`` is for one thread."""

    def __init__(
        self,
        out: Path,
        *,
        clock: Clock,
        make_meta: Callable[[int], FlightMeta],
        log_to: Callable[[PacketPipe | None], None],
        autopilot: Callable[[], str],
        wall_offset_ns: int,
        report: Callable[[str], None],
    ) -> None:
        """Record below ``out``, where earlier episodes stay.

        Args:
            out: from ``prepare_out``.
            clock: time of the begin of each episode.
            make_meta: the facts known at the begin, given its stamp.
            log_to: sends the vehicle's packets to a log from then on, or nowhere.
            autopilot: its name and version.
            wall_offset_ns: wall time minus the clock, for the logs.
            report: shows a line to the user; called by any thread.
        """
        self._out = out
        self._clock = clock
        self._make_meta = make_meta
        self._log_to = log_to
        self._autopilot = autopilot
        self._wall_offset_ns = wall_offset_ns
        self._report = report
        self._current: _Recording | None = None
        self._last: Finished | None = None
        self._marks: dict[int, bool | None] = {}
        self._next = 1 + max(map(_number, out.glob(f"{PREFIX}*")), default=0)

    def emit(self, event: Event) -> None:
        """Record the event if an episode is being recorded; a ``TickSink``."""
        current = self._current
        if current is not None:
            current.emit(event)

    @property
    def is_recording(self) -> bool:
        """An episode is being recorded."""
        return self._current is not None

    @property
    def number(self) -> int:
        """Number of this episode, or of the next one."""
        return self._next if self._current is None else self._current.number

    @property
    def folder(self) -> Path | None:
        """Folder of the episode that is being recorded."""
        return None if self._current is None else self._current.folder

    @property
    def duration_ns(self) -> int:
        """Length of the episode that is being recorded."""
        return 0 if self._current is None else self._clock.now_ns() - self._current.begin_ns

    @property
    def crash(self) -> str | None:
        """How the vehicle has crashed in this episode, or None."""
        return None if self._current is None else self._current.recorder.crash

    @property
    def finished(self) -> int:
        """Episodes recorded in this session."""
        return len(self._marks)

    @property
    def counts(self) -> Counter[bool | None]:
        """Episodes of this session that are good (True), bad (False) and unmarked (None)."""
        return Counter(self._marks.values())

    def begin(self) -> None:
        """Begin an episode.

        Raises:
            UserError, WriterError: its folder cannot be written, or its writer not started.
        """
        folder = self._out / f"{PREFIX}{self._next:04}"
        prepare_folder(folder)
        begin_ns = self._clock.now_ns()
        try:
            pipe = open_tlog_pipe()
            log = PacketPipe(os.dup(pipe.writer.fileno()), wall_offset_ns=self._wall_offset_ns)
            pipe.writer.close()
            recorder = Recorder(
                folder,
                self._make_meta(begin_ns),
                tlog_pipe=pipe,
                packets_dropped=lambda: log.dropped,
                autopilot=self._autopilot,
                report=self._report,
            )
        except OSError as error:
            raise UserError(f"{folder}: {error}") from error
        self._log_to(log)
        self._current = _Recording(folder, self._next, begin_ns, log, recorder)
        self._next += 1

    def end(self, reason: str) -> None:
        """End the episode that is being recorded, mark it, and say what is in it."""
        current, self._current = self._current, None
        if current is None:
            return
        seconds = (self._clock.now_ns() - current.begin_ns) / NS_PER_S
        self._log_to(None)
        current.log.close()
        current.recorder.close(CLOSE_S)
        self._last = Finished(current.folder, current.number, current.recorder.meta)
        self._marks[current.number] = self._last.meta.success
        if current.mark is not None:
            self._write_mark(current.mark)
        self._report(
            f"episode {current.number}: {seconds:.1f} s, ended by {reason}, {self._verdict()}; "
            f"{current.recorder.summary()}"
        )

    def mark(self, mark: Mark) -> None:
        """Mark the episode that is being recorded, or else the last one."""
        if self._current is not None:
            self._current.mark = mark
            self._report(f"episode {self._current.number} will be marked as {mark}")
        elif self._last is not None:
            self._write_mark(mark)
            self._report(f"episode {self._last.number}: {self._verdict()}")
        else:
            self._report("there is no episode yet to mark")

    def _write_mark(self, mark: Mark) -> None:
        if self._last is None:
            return
        meta = replace(self._last.meta, success=mark == "good")
        self._last = self._last._replace(meta=meta)
        self._marks[self._last.number] = meta.success
        try:
            write_meta(self._last.folder, meta)
        except OSError as error:
            self._report(f"episode {self._last.number} cannot be marked: {error}")

    def _verdict(self) -> str:
        meta = self._last.meta if self._last is not None else None
        if meta is None or (meta.success is None and meta.crash is None):
            return "not marked (g good, b bad)"
        word = "good" if meta.success else "bad"
        return word if meta.crash is None else f"{word} (crashed: {meta.crash})"


def prepare_out(out: Path) -> None:
    """Make the folder of the episodes; raises UserError if none can be recorded there."""
    if (out / META).exists():
        raise UserError(f"--out {out} is a flight itself: name a folder for several of them")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"--out {out} cannot be made: {error.strerror}") from error
    if not os.access(out, os.W_OK):
        raise UserError(f"--out {out} cannot be written to")


def _number(folder: Path) -> int:
    digits = folder.name.removeprefix(PREFIX)
    return int(digits) if digits.isdecimal() else 0
