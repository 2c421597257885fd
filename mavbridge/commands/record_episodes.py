"""Start and end of episodes, their folders, recorders and marks, and the room on the disk."""

import os
import threading
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from shutil import disk_usage
from typing import Literal, TypeAlias

from mavbridge.core.clock import NS_PER_MS, NS_PER_S, Clock, wall_offset_ns
from mavbridge.core.errors import UserError
from mavbridge.core.records import Event, Tick
from mavbridge.core.switch import Switch, SwitchPosition
from mavbridge.core.vehicle import ForwardedPacket
from mavbridge.flight.observers import flight_meta
from mavbridge.flight.plan import FlightPlan
from mavbridge.mavlink.codec.tlog import PacketPipe
from mavbridge.recording.folder import FlightMeta, prepare_folder, write_meta
from mavbridge.recording.recorder import Recorder
from mavbridge.recording.tlog import open_tlog_pipe
from policy.data.flight_files import META

QUIT_KEY, TOGGLE_KEY, GOOD_KEY, BAD_KEY = "q", "r", "g", "b"
KEYS = (QUIT_KEY, TOGGLE_KEY, " ", GOOD_KEY, BAD_KEY)
KEYS_HINT = "r or space begins and ends an episode, g marks it as good, b as bad, q ends"
AFTER_DISARM_NS = NS_PER_S
"""Recording time after disarming, in which a fall shows if the vehicle was in the air."""
MAX_READINGS = 60_000
"""Readings of the switch while an episode is closed, for ``CLOSE_S`` at the fastest rate."""
MIDDLE_NS = 300 * NS_PER_MS
"""A switch on its way from high to low passes the middle within this time."""

Mark: TypeAlias = Literal["good", "bad"]
_MARKS: dict[str, Mark] = {GOOD_KEY: "good", BAD_KEY: "bad"}


class EpisodeControl:
    """Decides when an episode is wanted; a ``TickSink`` of the readings of the switch.

    Call ``step`` about twenty times a second. Closing an episode takes longer, and the switch is
    also moved meanwhile.
    """

    def __init__(self, *, on_arm: bool, channel: int | None = None) -> None:
        """``channel``: number of the switch's radio channel, from 1; None: no switch."""
        self._on_arm = on_arm
        self._channel = channel
        self._readings: deque[tuple[int, int]] = deque(maxlen=MAX_READINGS)
        """Stamp and pulse width of each reading since the last step."""
        self._switch = Switch(rests=("low", "middle"))
        self._position: SwitchPosition | None = None
        """Last known position, kept through readings without one."""
        self._middle_since_ns: int | None = None
        """Time at which the switch moved from high to the middle after an episode."""
        self._is_taken = False
        """True if an episode has been in progress since the switch went high."""
        self._was_armed = False
        self._disarmed_ns: int | None = None
        self.wanted: str | None = None
        """What asks for an episode, as long as it does; an obstacle can still disappear. Set to
        None when an episode has ended by itself: only another act then begins one."""
        self.ended_by = ""
        """What last asked for an end."""

    def emit(self, event: Event) -> None:
        """Keep the reading of the switch for the next step."""
        if self._channel is not None and isinstance(event, Tick):
            for switch_us in event.rc_channels_us[self._channel - 1 : self._channel]:
                self._readings.append((event.woke_ns, switch_us))

    @property
    def may_mark(self) -> bool:
        """True if the switch may be about to mark the last episode."""
        return self._middle_since_ns is not None

    def step(self, now_ns: int, *, armed: bool, is_recording: bool, keys: str = "") -> Mark | None:
        """Advance to this time; return a mark for the current episode, or else for the last one.

        ``keys`` were typed since the last step, in order.
        """
        mark: Mark | None = None
        for _ in range(len(self._readings)):
            mark = self._by_switch(*self._readings.popleft(), is_recording) or mark
        if self._on_arm:
            self._by_arming(now_ns, armed)
        for key in keys:
            mark = _MARKS.get(key, mark)
            if key in (TOGGLE_KEY, " "):
                self._want(self.wanted is None, "a key")
        return mark

    def _want(self, is_wanted: bool, by: str) -> None:
        if is_wanted:
            self.wanted = self.wanted or by
        else:
            self.wanted, self.ended_by = None, by

    def _by_switch(self, now_ns: int, switch_us: int, is_recording: bool) -> Mark | None:
        is_act = self._switch.read(switch_us, now_ns)
        before, now = self._position, self._switch.position or self._position
        self._is_taken = is_recording or (self._is_taken and before == "high")
        self._position = now
        if now == "high":
            self._middle_since_ns = None
            if is_act:
                self._want(True, "the switch")
        elif before == "high":
            self._middle_since_ns = now_ns if now == "middle" and self._is_taken else None
            self._want(False, "the switch")
        elif now == "low":
            self._middle_since_ns = None
        elif self._middle_since_ns and now_ns - self._middle_since_ns >= MIDDLE_NS:
            self._middle_since_ns = None
            return "bad"
        return None

    def _by_arming(self, now_ns: int, armed: bool) -> None:
        was_armed, self._was_armed = self._was_armed, armed
        if armed:
            self._disarmed_ns = None
            if not was_armed:
                self._want(True, "armed")
        elif was_armed:
            self._disarmed_ns = now_ns
        elif self._disarmed_ns and now_ns - self._disarmed_ns >= AFTER_DISARM_NS:
            self._disarmed_ns = None
            self._want(False, "disarmed")


LEAST_GB = 0.1
"""Room on the disk above --disk-reserve without which no episode begins: minutes of 224 x 224."""


def disk_left_gb(folder: Path, reserve_gb: float) -> float:
    """Return the room on the disk above the reserve; raise OSError if unknown."""
    return max(0.0, disk_usage(folder).free / 1e9 - reserve_gb)


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
    _first: dict[type[Event], int] = field(default_factory=dict)
    """Number of the first recorded tick, and of the first frame."""

    @property
    def meta(self) -> FlightMeta:
        """Facts of the flight; the mark has the last word on its success."""
        meta = self.recorder.meta
        return meta if self.mark is None else replace(meta, success=self.mark == "good")

    @property
    def obstacle(self) -> str | None:
        """Why recording cannot go on, for the report of its end; None if it can."""
        crash, loss = self.recorder.crash, self.recorder.loss
        if loss is not None:
            return f"an error ({loss})"
        return None if crash is None else f"a crash ({crash})"

    def emit(self, event: Event) -> None:
        """Record an event, numbered from the first of the episode."""
        first = self._first.setdefault(type(event), event.serial)
        self.recorder.emit(replace(event, serial=event.serial - first))


class Episodes:
    """Begins, ends and marks episodes. Everything is for one thread, except ``emit`` and
    ``watch_packets``."""

    def __init__(
        self,
        out: Path,
        plan: FlightPlan,
        *,
        clock: Clock,
        autopilot: Callable[[], str],
        report: Callable[[str], None],
    ) -> None:
        """Record below ``out``, where earlier episodes are kept; any thread calls ``report``."""
        self._out = out
        self._plan = plan
        self._clock = clock
        self._autopilot = autopilot
        self._report = report
        self._log_lock = threading.Lock()
        self.current: Episode | None = None
        self._last: Episode | None = None
        self._marks: dict[int, bool | None] = {}
        self._next = 1 + max(map(_number, out.glob(f"{PREFIX}*")), default=0)

    def emit(self, event: Event) -> None:
        """Record the event if an episode is in progress; a ``TickSink``."""
        if (episode := self.current) is not None:
            episode.emit(event)

    def watch_packets(self, packets: tuple[ForwardedPacket, ...]) -> None:
        """Log the vehicle's packets if an episode is in progress."""
        with self._log_lock:
            if (episode := self.current) is not None:
                for packet in packets:
                    episode.log.put(packet.arrived_ns, packet.data)

    @property
    def number(self) -> int:
        """Number of the current episode, or of the next one."""
        return self._next if self.current is None else self.current.number

    @property
    def counts(self) -> Counter[bool | None]:
        """Number of episodes of this session: good (True), bad (False) and unmarked (None)."""
        return Counter(self._marks.values())

    def begin(self) -> None:
        """Begin an episode once its writer process runs: 0.7 to 1.6 s on two shared cores.

        Raises:
            UserError, WriterError: its folder cannot be written, or its writer does not start.
        """
        folder = self._out / f"{PREFIX}{self._next:04}"
        prepare_folder(folder, "--out")
        start_ns, offset_ns = self._clock.now_ns(), wall_offset_ns(self._clock)
        try:
            pipe = open_tlog_pipe()
            log = PacketPipe(os.dup(pipe.writer.fileno()), wall_offset_ns=offset_ns)
            pipe.writer.close()
            recorder = Recorder(
                folder,
                flight_meta(self._plan, "pilot", start_ns, offset_ns),
                tlog_pipe=pipe,
                packets_dropped=lambda: log.dropped,
                autopilot=self._autopilot,
                report=self._report,
            )
        except OSError as error:
            raise UserError(f"{folder}: {error}") from error
        self.current = Episode(
            folder=folder,
            number=self._next,
            begin_ns=self._clock.now_ns(),
            log=log,
            recorder=recorder,
        )
        self._next += 1

    def end(self, reason: str) -> None:
        """End the current episode, mark it, and report its contents."""
        episode, self.current = self.current, None
        if episode is None:
            return
        seconds = (self._clock.now_ns() - episode.begin_ns) / NS_PER_S
        with self._log_lock:
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
