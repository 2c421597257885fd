"""Start and end of episodes, their folders, recorders and marks, and the room on the disk."""

import os
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from shutil import disk_usage
from typing import Literal, NamedTuple, TypeAlias

from mavbridge.core.clock import NS_PER_MS, NS_PER_S, Clock
from mavbridge.core.errors import UserError
from mavbridge.core.records import Event, Tick
from mavbridge.core.switch import Position, Switch
from mavbridge.mavlink.transport.packet_pipe import PacketPipe
from mavbridge.recording.folder import META, prepare_folder
from mavbridge.recording.meta import FlightMeta, write_meta
from mavbridge.recording.recorder import Recorder
from mavbridge.recording.tlog import open_tlog_pipe

QUIT_KEY, TOGGLE_KEY, GOOD_KEY, BAD_KEY = "q", "r", "g", "b"
KEYS = (QUIT_KEY, TOGGLE_KEY, " ", GOOD_KEY, BAD_KEY)
KEYS_HINT = "r or space begins and ends an episode, g marks it as good, b as bad, q ends"
AFTER_DISARM_NS = NS_PER_S
"""Recording time after disarming, in which a fall shows if the vehicle was in the air."""
MIDDLE_NS = 300 * NS_PER_MS
"""A switch on its way from high to low passes the middle within this time."""

Mark: TypeAlias = Literal["good", "bad"]
_MARKS: dict[str, Mark] = {GOOD_KEY: "good", BAD_KEY: "bad"}


class Seen(NamedTuple):
    """Inputs of the episode control at one time."""

    now_ns: int
    armed: bool
    switch_us: int
    """Pulse width of the switch's channel; 0: no reading."""
    is_recording: bool
    keys: str = ""
    """Keys typed since the last step, in order."""


@dataclass(slots=True, kw_only=True)
class Orders:
    """Actions for the recorder, in the order of execution."""

    mark_before: Mark | None = None
    """Mark for the current episode, or else for the last one."""
    end: str | None = None
    """End the current episode for this reason."""
    begin: str | None = None
    """Begin an episode for this reason."""
    quit: bool = False


class EpisodeControl:
    """Decides when episodes begin and end. Call ``step`` about twenty times a second."""

    def __init__(self, *, has_switch: bool, on_arm: bool) -> None:
        self._has_switch = has_switch
        self._on_arm = on_arm
        self._switch = Switch(rests=("low", "middle"))
        self._position: Position | None = None
        """Last known position, kept through readings without one."""
        self._middle_since_ns: int | None = None
        """Time at which the switch moved from high to the middle."""
        self._was_armed = False
        self._disarmed_ns: int | None = None
        self._wanted: str | None = None
        """Why the switch or the arming asks for an episode that could not begin yet."""

    def step(self, seen: Seen) -> Orders:
        """Advance to this time; return the resulting orders."""
        orders = Orders()
        if self._has_switch:
            self._by_switch(seen, orders)
        if self._on_arm:
            self._by_arming(seen, orders)
        # Repeat the request while switch or arming asks: the obstacle can still disappear.
        is_on = self._position == "high" if self._has_switch else seen.armed
        if orders.begin is not None:
            self._wanted = orders.begin
        elif seen.is_recording or not is_on:
            self._wanted = None
        orders.begin = self._wanted
        self._by_keys(seen, orders)
        return orders

    def _by_keys(self, seen: Seen, orders: Orders) -> None:
        for key in seen.keys:
            orders.mark_before = _MARKS.get(key, orders.mark_before)
        orders.quit = QUIT_KEY in seen.keys
        is_toggled = sum(seen.keys.count(key) for key in (TOGGLE_KEY, " ")) % 2 == 1
        if seen.is_recording and (is_toggled or orders.quit):
            orders.end = "a key"
        elif is_toggled and not orders.quit:
            orders.begin = "a key"

    def _by_switch(self, seen: Seen, orders: Orders) -> None:
        is_act = self._switch.read(seen.switch_us, seen.now_ns)
        before, now = self._position, self._switch.position or self._position
        self._position = now
        if now == "high":
            self._middle_since_ns = None
            orders.begin = "the switch" if is_act else None
        elif before == "high":
            self._middle_since_ns = seen.now_ns if now == "middle" else None
            orders.end = "the switch" if seen.is_recording else None
        elif now == "low":
            self._middle_since_ns = None
        elif self._middle_since_ns and seen.now_ns - self._middle_since_ns >= MIDDLE_NS:
            self._middle_since_ns = None
            orders.mark_before = "bad"

    def _by_arming(self, seen: Seen, orders: Orders) -> None:
        was_armed, self._was_armed = self._was_armed, seen.armed
        if seen.armed:
            self._disarmed_ns = None
            orders.begin = None if was_armed or seen.is_recording else "armed"
            return
        if was_armed:
            self._disarmed_ns = seen.now_ns
        if self._disarmed_ns and seen.now_ns - self._disarmed_ns >= AFTER_DISARM_NS:
            self._disarmed_ns = None
            orders.end = "disarmed" if seen.is_recording else None


FIRST_BYTES_PS = 600_000.0
"""Assumed before a measurement: twice the rate of 224 x 224 at 30 Hz and 100 rows a second."""
LEAST_S = 60.0
"""Recording time for which the disk must have room when an episode begins [s]."""
MEASURED_NS = 5 * NS_PER_S
"""Shortest episode from which the bytes per second are measured."""


class DiskWatch:
    """Room on the disk, in recording time at the data rate of the newest episode."""

    def __init__(self, folder: Path, *, reserve_bytes: float) -> None:
        self._folder = folder
        self._reserve_bytes = reserve_bytes
        self._bytes_ps = FIRST_BYTES_PS

    def measure(self, episode: Path, duration_ns: int) -> None:
        """Measure the data rate of an episode if it is long enough; raise OSError if unreadable."""
        if duration_ns >= MEASURED_NS:
            size = sum(entry.stat().st_size for entry in episode.iterdir())
            self._bytes_ps = max(1.0, size * NS_PER_S / duration_ns)

    def left_s(self) -> float:
        """Return the recording time until only the reserve is left; raise OSError if unknown."""
        free_bytes = disk_usage(self._folder).free
        return max(0.0, (free_bytes - self._reserve_bytes) / self._bytes_ps)

    def missing(self) -> str | None:
        """Return the room that another episode lacks, or None; raise OSError if unknown."""
        if (left_s := self.left_s()) >= LEAST_S:
            return None
        return f"room on the disk for {left_s:.0f} of {LEAST_S:.0f} s above --disk-reserve"


PREFIX = "episode-"
CLOSE_S = 60.0
"""Timeout for closing an episode; converting the tables of a long one to Parquet takes seconds."""


@dataclass(kw_only=True)
class Episode:
    """Current or past episode. Ticks come from one thread, frames from another."""

    folder: Path
    number: int
    begin_ns: int
    log: PacketPipe
    recorder: Recorder
    mark: Mark | None = None
    _first_tick: int | None = None
    _first_frame: int | None = None

    @property
    def meta(self) -> FlightMeta:
        """Facts of the flight; the mark has the last word on its success."""
        meta = self.recorder.meta
        return meta if self.mark is None else replace(meta, success=self.mark == "good")

    def emit(self, event: Event) -> None:
        """Record events since the start of the episode, numbered from there."""
        if isinstance(event, Tick):
            if event.woke_ns >= self.begin_ns:
                self._first_tick = event.serial if self._first_tick is None else self._first_tick
                self.recorder.emit(replace(event, serial=event.serial - self._first_tick))
        elif event.captured_ns >= self.begin_ns:
            self._first_frame = event.serial if self._first_frame is None else self._first_frame
            self.recorder.emit(replace(event, serial=event.serial - self._first_frame))


class Episodes:
    """Begins, ends and marks episodes. Everything except ``emit`` is for one thread."""

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
        """Record below ``out``, where earlier episodes are kept.

        Args:
            out: from ``prepare_out``.
            clock: time of the start of each episode.
            make_meta: returns the facts known at the start, given its stamp.
            log_to: sends the vehicle's packets to a log from then on; None stops that.
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
        self.current: Episode | None = None
        self._last: Episode | None = None
        self._marks: dict[int, bool | None] = {}
        self._next = 1 + max(map(_number, out.glob(f"{PREFIX}*")), default=0)

    def emit(self, event: Event) -> None:
        """Record the event if an episode is in progress; a ``TickSink``."""
        current = self.current
        if current is not None:
            current.emit(event)

    @property
    def number(self) -> int:
        """Number of the current episode, or of the next one."""
        return self._next if self.current is None else self.current.number

    @property
    def counts(self) -> Counter[bool | None]:
        """Number of episodes of this session: good (True), bad (False) and unmarked (None)."""
        return Counter(self._marks.values())

    def begin(self) -> None:
        """Begin an episode.

        Raises:
            UserError, WriterError: its folder cannot be written, or its writer does not start.
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
        self.current = Episode(
            folder=folder, number=self._next, begin_ns=begin_ns, log=log, recorder=recorder
        )
        self._next += 1

    def end(self, reason: str) -> None:
        """End the current episode, mark it, and report its contents."""
        episode, self.current = self.current, None
        if episode is None:
            return
        seconds = (self._clock.now_ns() - episode.begin_ns) / NS_PER_S
        self._log_to(None)
        episode.log.close()
        episode.recorder.close(CLOSE_S)
        self._last = episode
        self._keep_mark(episode)
        self._report(
            f"episode {episode.number}: {seconds:.1f} s, ended by {reason}, {_verdict(episode)}; "
            f"{episode.recorder.summary()}"
        )

    def mark(self, mark: Mark) -> None:
        """Mark the current episode, or else the last one."""
        episode = self.current or self._last
        if episode is None:
            self._report("there is no episode yet to mark")
            return
        episode.mark = mark
        if episode is self.current:
            self._report(f"episode {episode.number} will be marked as {mark}")
        else:
            self._keep_mark(episode)
            self._report(f"episode {episode.number}: {_verdict(episode)}")

    def _keep_mark(self, episode: Episode) -> None:
        self._marks[episode.number] = episode.meta.success
        if episode.mark is not None:
            try:
                write_meta(episode.folder, episode.meta)
            except OSError as error:
                self._report(f"episode {episode.number} cannot be marked: {error}")


def _verdict(episode: Episode) -> str:
    success, crash = episode.meta.success, episode.meta.crash
    if success is None and crash is None:
        return "not marked (g good, b bad)"
    word = "good" if success else "bad"
    return word if crash is None else f"{word} (crashed: {crash})"


def prepare_out(out: Path) -> None:
    """Create the folder of the episodes; raise UserError if none can be recorded there."""
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
