"""The vehicle during a recording, and the status line of the terminal."""

from dataclasses import replace

from rich.text import Text

from mavbridge.commands.record.episodes import Episodes
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.reasons import Code, because
from mavbridge.core.records import Tick
from mavbridge.core.ticks import GuardTick
from mavbridge.core.vehicle import Sticks
from mavbridge.flight.telemetry_cache import TelemetryCache
from mavbridge.observe.terminal import FlightScreen, age, number, rate_style
from policy.contract import Contract

PILOTS = because(Code.PILOT_FLIES)
CONTRACT = Contract(feature_dim=1, arrays="numpy")
"""Meaning of the recorded sticks: those of a policy with the default contract, to which the
vehicle's own sticks are mapped."""


class PilotView(TelemetryCache):
    """``TelemetryCache`` of a vehicle that its pilot flies."""

    def _join(self, sent: GuardTick) -> Tick:
        """Return a tick of the pilot's, since no policy flies."""
        return replace(super()._join(sent), release_reason=PILOTS, phase="released")


LOW_GB = 1.0
"""Room on the disk below which it is shown as a warning."""


class RecordScreen(FlightScreen):
    """``FlightScreen`` with a status line for the pilot. Any thread can replace ``shown``."""

    shown: tuple[Text, Text] | None = None
    """Begin and end of the status line; see ``session_status``."""

    def status_line(self) -> Text:
        """Return the current status. Call at ``STATUS_HZ``: rates are averages over calls."""
        camera_hz, shown, tick = self._vision.sample_hz(), self.shown, self._tick
        if shown is None or tick is None:
            return Text("waiting for the vehicle", style="dim")
        attitude_ns = None if tick.state is None else tick.state.attitude_ns
        line = Text(no_wrap=True, overflow="ellipsis")
        line.append(shown[0])
        line.append(f"  {tick.mode or 'mode unknown'} {'armed' if tick.armed else 'disarmed'}")
        line.append(f"  {_sticks(tick.rc_sticks)}")
        line.append(f"  state {age(tick.sent_ns, attitude_ns)}  camera ")
        line.append(f"{number(camera_hz, 1)} Hz", style=rate_style(camera_hz, self._target_hz[1]))
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
