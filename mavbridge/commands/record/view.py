"""The vehicle during a recording, and the status line of the terminal."""

import threading
from dataclasses import replace

from rich.console import Console
from rich.text import Text

from mavbridge.commands.record.episodes import Episodes
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

    @property
    def is_airborne(self) -> bool:
        """True if the pilot flies: the vehicle is armed and not landed."""
        return self.status.armed and self.status.is_landed is False

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


class RecordScreen(FlightScreen):
    """``FlightScreen`` with a status line for the pilot. Any thread can replace ``shown``."""

    def __init__(self, console: Console, *, rate_hz: float, vision_hz: float) -> None:
        super().__init__(console, action_hz=rate_hz, vision_hz=vision_hz, readonly=True)
        self.shown: tuple[Text, Text] | None = None
        """Begin and end of the status line; see ``session_status``."""
        self.sticks = RateMeter()
        """Packets with the pilot's sticks."""
        self._wanted_hz = (rate_hz, vision_hz)
        self._states, self._images = RateMeter(), RateMeter()
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
        if shown is None or tick is None:
            return Text("waiting for the vehicle", style="dim")
        line = Text(no_wrap=True, overflow="ellipsis")
        line.append(shown[0])
        line.append(f"  {tick.mode or 'mode unknown'} {'armed' if tick.armed else 'disarmed'}")
        line.append(f"  {_sticks(tick.rc_sticks)}")
        rate_hz, vision_hz = self._wanted_hz
        for name, meter, wanted_hz in (
            ("sticks", self.sticks, None),
            ("state", self._states, rate_hz),
            ("camera", self._images, vision_hz),
        ):
            hz = meter.sample_hz()
            line.append(f"  {name} ")
            style = "" if wanted_hz is None else rate_style(hz, wanted_hz)
            line.append(f"{number(hz, 1)} Hz", style=style)
        return line.append(shown[1])


def session_status(
    episodes: Episodes, *, now_ns: int, disk_gb: float, problem: str | None
) -> tuple[Text, Text]:
    """Return the begin and the end of the status line.

    ``disk_gb`` is the room above --disk-reserve; ``problem`` a missing requirement, or a doubt
    about the value of the recording.
    """
    if episodes.current is None:
        begin = Text(f"next: episode {episodes.number}", style="bold yellow")
    else:
        seconds = (now_ns - episodes.current.begin_ns) / NS_PER_S
        begin = Text(f"RECORDING episode {episodes.number} {seconds:5.1f} s", style="bold red")
    counts = episodes.counts
    end = Text.assemble(
        (f"  disk {disk_gb:.1f} GB", "yellow" if disk_gb < LOW_GB else ""),
        f"  {counts[True]} good {counts[False]} bad {counts[None]} unmarked",
        ("" if problem is None else f"  {problem}", "bold yellow"),
    )
    return begin, end


def _sticks(sticks: Sticks | None) -> str:
    if sticks is None:
        return "no sticks"
    return " ".join(
        f"{name}{value:+.2f}" for name, value in zip(("T", "Y", "P", "R"), sticks, strict=True)
    )
