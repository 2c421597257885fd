"""The vehicle during a recording, and the status line of the terminal."""

import threading
from collections import Counter
from dataclasses import dataclass, replace

from rich.console import Console
from rich.text import Text

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.reasons import Code, because
from mavbridge.core.records import Event, Tick, TickSink
from mavbridge.core.vehicle import ForwardedPacket, Packet, Sticks
from mavbridge.flight.plan import FlightPlan
from mavbridge.flight.telemetry_cache import TelemetryCache
from mavbridge.guard.channel import SocketPort
from mavbridge.mavlink.codec.frames import frame_at
from mavbridge.mavlink.codec.readers import IDS
from mavbridge.mavlink.codec.tlog import PacketPipe
from mavbridge.observe.terminal import FlightScreen, RateMeter, number, rate_style
from policy.contract import Contract

STICK_IDS = {"ardupilot": IDS["RC_CHANNELS"], "px4": IDS["MANUAL_CONTROL"]}
"""Message with the pilot's sticks, by the first word of the autopilot's name."""
STICKS_FRESH_NS = 500 * NS_PER_MS
"""Older sticks do not count as the pilot's: PX4 goes silent when its receiver does."""
PILOTS = because(Code.PILOT_FLIES)
CONTRACT = Contract(feature_dim=1, arrays="numpy")
"""Meaning of the recorded sticks: those of a policy with the default contract, to which the
vehicle's own sticks are mapped."""


class PilotView(TelemetryCache):
    """``TelemetryCache`` that passes its ticks on as the pilot's, logs the vehicle's packets, and
    counts those with sticks."""

    def __init__(self, plan: FlightPlan, *, sink: TickSink, samples: SocketPort) -> None:
        super().__init__(plan, sink=self, samples=samples, watch_packets=self._watch)
        self._pilot_sink = sink
        self._log: PacketPipe | None = None
        self._log_lock = threading.Lock()
        self.sticks_ns = 0
        """Arrival of the newest sticks."""
        self.stick_packets = 0

    def log_to(self, log: PacketPipe | None) -> None:
        """Log the vehicle's packets here from now on; None: nowhere. The last log is then free."""
        with self._log_lock:
            self._log = log

    def _watch(self, packets: tuple[ForwardedPacket, ...]) -> None:
        stick_id = STICK_IDS.get(self.status.autopilot.partition(" ")[0])
        with self._log_lock:
            for packet in packets:
                if self._log is not None:
                    self._log.put(Packet(packet.arrived_ns, packet.data))
                frame = frame_at(packet.data, 0)
                if frame is not None and frame.message_id == stick_id:
                    self.sticks_ns = packet.arrived_ns
                    self.stick_packets += 1

    def emit(self, event: Event) -> None:
        """Pass a tick on as flown by the pilot, since no policy flies, and without stale sticks."""
        if isinstance(event, Tick):
            is_fresh = event.woke_ns - self.sticks_ns <= STICKS_FRESH_NS
            event = replace(
                event,
                rc_sticks=event.rc_sticks if is_fresh else None,
                release_reason=PILOTS,
                phase="released",
            )
        self._pilot_sink.emit(event)


LOW_GB = 1.0
"""Room on the disk below which it is shown as a warning."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Shown:
    """Contents of the status line besides the newest tick."""

    number: int
    duration_ns: int | None
    """Length of the current episode; None while none is recorded."""
    counts: Counter[bool | None]
    """Number of good, bad and unmarked episodes."""
    disk_gb: float
    """Room on the disk above --disk-reserve."""
    stick_packets: int
    sticks_ns: int
    """Number of packets with the pilot's sticks so far, and the arrival of the newest."""
    problem: str | None
    """A missing requirement, or a doubt about the value of the recording."""


class RecordScreen(FlightScreen):
    """``FlightScreen`` with a status line for the pilot. Any thread can replace ``shown``."""

    def __init__(self, console: Console, *, rate_hz: float, vision_hz: float) -> None:
        super().__init__(console, action_hz=rate_hz, vision_hz=vision_hz, readonly=True)
        self.shown: Shown | None = None
        self._wanted_hz = (rate_hz, vision_hz)
        self._states, self._images, self._sticks = RateMeter(), RateMeter(), RateMeter()
        self._newest: Tick | None = None
        self._state_ns = 0

    def emit(self, event: Event) -> None:
        """Store the event and its messages."""
        if not isinstance(event, Tick):
            self._images.count(event.ready_ns)
            return
        for text in event.texts:
            self.show_message(text)
        if event.state is not None and event.state.attitude_ns != self._state_ns:
            self._state_ns = event.state.attitude_ns
            self._states.count(event.woke_ns)
        self._newest = event

    def status_line(self) -> Text:
        """Return the current status. Call at ``STATUS_HZ``: rates are averages over calls."""
        shown, tick = self.shown, self._newest
        line = Text(no_wrap=True, overflow="ellipsis")
        if shown is None or tick is None:
            line.append("waiting for the vehicle", style="dim")
            return line
        if shown.duration_ns is None:
            line.append(f"next: episode {shown.number}", style="bold yellow")
        else:
            seconds = shown.duration_ns / NS_PER_S
            line.append(f"RECORDING episode {shown.number} {seconds:5.1f} s", style="bold red")
        line.append(f"  {tick.mode or 'mode unknown'} {'armed' if tick.armed else 'disarmed'}")
        line.append(f"  {_sticks(tick.rc_sticks)}")
        self._sticks.set(shown.stick_packets, shown.sticks_ns)
        rate_hz, vision_hz = self._wanted_hz
        for name, meter, wanted_hz in (
            ("sticks", self._sticks, None),
            ("state", self._states, rate_hz),
            ("camera", self._images, vision_hz),
        ):
            hz = meter.sample_hz()
            line.append(f"  {name} ")
            style = "" if wanted_hz is None else rate_style(hz, wanted_hz)
            line.append(f"{number(hz, 1)} Hz", style=style)
        style = "yellow" if shown.disk_gb < LOW_GB else ""
        line.append(f"  disk {shown.disk_gb:.1f} GB", style=style)
        counts = shown.counts
        line.append(f"  {counts[True]} good {counts[False]} bad {counts[None]} unmarked")
        if shown.problem is not None:
            line.append(f"  {shown.problem}", style="bold yellow")
        return line


def _sticks(sticks: Sticks | None) -> str:
    if sticks is None:
        return "no sticks"
    return " ".join(
        f"{name}{value:+.2f}" for name, value in zip(("T", "Y", "P", "R"), sticks, strict=True)
    )
