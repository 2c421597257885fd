"""The terminal during a flight: one status line while flying, a table afterwards."""

from collections import deque
from contextlib import AbstractContextManager, nullcontext

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from mavbridge.config.rates import STATUS_HZ
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.records import Event, Tick
from mavbridge.core.vehicle import LinkStats
from mavbridge.observe.timing import TimingReport

RATE_WINDOW_S = 1.0
PLAIN_PERIOD_S = 5.0
"""Interval between lines if the output is not a terminal."""
RELEASES_SHOWN = 3
MAX_MESSAGES = 100
"""Messages that may wait for the next refresh; the oldest are dropped first."""
_NOT_MEASURED = "-"
_STYLE_GOOD, _STYLE_POOR, _STYLE_BAD = "green", "yellow", "red"
_LEGEND = (
    "new attitude to wire: from the arrival of a new attitude until the first sticks based on it "
    "are sent. A slot is one period of the action loop; it is missed when the loop is too late."
)


class _RateMeter:
    """Rate of a series of stamps over the last ``RATE_WINDOW_S`` of refreshes."""

    def __init__(self) -> None:
        self._samples: deque[tuple[int, int]] = deque(maxlen=round(RATE_WINDOW_S * STATUS_HZ) + 1)
        self._newest = (0, 0)

    def count(self, stamp_ns: int) -> None:
        """Count an event; count and stamp change in one step, since another thread reads them."""
        self._newest = (self._newest[0] + 1, stamp_ns)

    def sample_hz(self) -> float | None:
        """Events per second, to be called once a refresh; None while no events come."""
        if self._newest[0] == 0:
            return None
        self._samples.append(self._newest)
        (first, first_ns), (last, last_ns) = self._samples[0], self._samples[-1]
        return (last - first) * NS_PER_S / (last_ns - first_ns) if last_ns > first_ns else None


class FlightScreen:
    """Status line and final table on one console; a ``TickSink``.

    ``emit`` is for the loops' threads, ``show_message`` for any thread, the rest for the main one.
    """

    def __init__(
        self, console: Console, *, action_hz: float, vision_hz: float, readonly: bool
    ) -> None:
        self._console = console
        self._target_hz = (action_hz, vision_hz)
        self._readonly = readonly
        self._action, self._vision = _RateMeter(), _RateMeter()
        self._tick: Tick | None = None
        self._missed_slots = 0
        self._messages: deque[str] = deque(maxlen=MAX_MESSAGES)
        self._live = Live(console=console, auto_refresh=False, transient=True)
        self._refreshes = 0

    def emit(self, event: Event) -> None:
        """Remember the event and the messages in it."""
        if not isinstance(event, Tick):
            self._vision.count(event.ready_ns)
            return
        self._action.count(event.woke_ns)
        self._missed_slots += event.missed_slots
        self._messages.extend(event.texts)
        if self._tick is None or event.activity != self._tick.activity:
            self._messages.append(event.activity)
        self._tick = event

    def show_message(self, text: str) -> None:
        """Show a message with the next refresh."""
        self._messages.append(text)

    def status_line(self) -> Text:
        """The status now; to be called at ``STATUS_HZ``, since rates are averages over calls."""
        rates_hz = (self._action.sample_hz(), self._vision.sample_hz())
        tick = self._tick
        if tick is None:
            return Text("waiting for the first tick", style="dim")
        line = Text(no_wrap=True, overflow="ellipsis")
        line.append(*self._state(tick))
        line.append(f"  {tick.mode or 'mode unknown'} {'armed' if tick.armed else 'disarmed'}")
        for name, rate_hz, target_hz in zip(
            ("action", "vision"), rates_hz, self._target_hz, strict=True
        ):
            line.append(f"  {name} ")
            line.append(f"{_rate(rate_hz)} Hz", style=_rate_style(rate_hz, target_hz))
        attitude_ns = None if tick.state is None else tick.state.attitude_ns
        line.append(f"  feature {_age(tick.sent_ns, tick.feature_captured_ns)}")
        line.append(f"  state {_age(tick.sent_ns, attitude_ns)}")
        line.append(f"  missed {self._missed_slots}")
        if tick.release_reason is not None:  # last: it may be long, and is cut first
            line.append(f"  {tick.release_reason}", style="yellow")
        return line

    def _state(self, tick: Tick) -> tuple[str, str]:
        if tick.release_reason is not None:
            return "RELEASED", "bold yellow"
        if self._readonly:
            return "READ-ONLY", "bold cyan"
        return "FLYING" if tick.trace else "PREPARING", "bold green"

    def live(self) -> AbstractContextManager[object]:
        """Show the status line, if there is a terminal, until the end of the block."""
        return self._live if self._console.is_terminal else nullcontext()

    def refresh(self) -> None:
        """Print new messages and the line, at ``STATUS_HZ``; without a terminal, less often."""
        self._print_messages()
        line = self.status_line()
        self._refreshes += 1
        if self._console.is_terminal:
            self._live.update(line, refresh=True)
        elif self._refreshes % round(PLAIN_PERIOD_S * STATUS_HZ) == 0:
            self._console.print(line, soft_wrap=True)

    def _print_messages(self) -> None:
        while self._messages:
            self._console.print(Text(self._messages.popleft()), soft_wrap=True)

    def show_report(self, report: TimingReport) -> None:
        """Print the last messages, the table of what was measured, and the verdicts."""
        self._print_messages()
        if (table := timing_table(report)) is not None:
            self._console.print(table)
        for verdict in verdicts(report):
            self._console.print(verdict, soft_wrap=not self._console.is_terminal)


def timing_table(report: TimingReport) -> Table | None:
    """Percentiles in milliseconds of what was measured in a flight; None if nothing was."""
    rows = {
        "action period": report.action.period_ms,
        "action jitter |period - target|": report.action.jitter_ms,
        "predict": report.action.predict_ms,
        "vision encode": report.vision.encode_ms,
        "feature age at send": report.feature_age_ms,
        "attitude age at send": report.state_age_ms,
        "new attitude to wire": report.state_to_wire_ms,
        "link round trip": report.link.rtt_ms if report.link else None,
    }
    if not any(rows.values()):
        return None
    table = Table(
        title=f"{report.duration_s:.1f} s, {report.mode} rate: {report.policy} on {report.engine}, "
        f"{report.autopilot or 'no vehicle'}",
        title_justify="left",
        title_style="bold",
        caption=_LEGEND,
        caption_justify="left",
    )
    table.add_column("ms")
    for name in ("p50", "p99", "p99.9", "max"):
        table.add_column(name, justify="right")
    for label, measured in rows.items():
        if measured is not None:
            values = (measured.p50, measured.p99, measured.p999, measured.max)
            table.add_row(label, *(f"{v:.2f}" if v < 1000 else f"{v:.0f}" for v in values))
    return table


def verdicts(report: TimingReport) -> list[Text]:
    """One line for each part of a flight: its target and its result."""
    action, vision = report.action, report.vision
    missed = f"{_counted(action.missed_slots, 'missed slot')} in {_counted(action.ticks, 'tick')}"
    dropped = f"{_counted(vision.dropped_frames, 'frame')} dropped by the camera"
    lines = []
    for name, loop, rest in (("action", action, missed), ("vision", vision, dropped)):
        text = f"{_rate(loop.rate_hz)} Hz of {loop.target_hz:g} Hz, {rest}"
        lines.append(_line(name, text, _rate_style(loop.rate_hz, loop.target_hz)))
    if report.link is not None:
        lines.append(_line("link", _link_verdict(report.link)))
    lines.append(_line("sticks", _release_verdict(report)))
    drops = {"rerun": report.observer_drops.rerun, "recorder": report.observer_drops.recorder}
    lines += [
        _line(name, f"missed {_counted(count, 'event')}", _STYLE_POOR)
        for name, count in drops.items()
        if count
    ]
    return lines


def _link_verdict(link: LinkStats) -> str:
    echo = {True: "echo confirmed", False: "NO ECHO from the vehicle", None: "echo not checked"}
    lost = (
        "loss not measured"
        if link.lost_fraction is None
        else f"{link.lost_fraction:.2%} of the vehicle's messages lost"
    )
    sent = f"{_counted(link.sent_overrides, 'stick message')} sent"
    return f"{sent}, {echo[link.echo_confirmed]}, {lost}"


def _release_verdict(report: TimingReport) -> str:
    if not report.releases:
        return "never released"
    last = report.releases[-RELEASES_SHOWN:]
    shown = "; ".join(f"{release.reason} ({release.t_s:.1f} s)" for release in last)
    more = "last " if report.release_count > len(last) else ""
    return f"released {_counted(report.release_count, 'time')}, {more}for: {shown}"


def _line(name: str, text: str, style: str = "") -> Text:
    return Text.assemble((f"{name:9}", "bold"), (text, style))


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


def _rate(rate_hz: float | None) -> str:
    return _NOT_MEASURED if rate_hz is None else f"{rate_hz:.1f}"


def _rate_style(rate_hz: float | None, target_hz: float) -> str:
    if rate_hz is None or rate_hz < 0.9 * target_hz:
        return _STYLE_BAD
    return _STYLE_GOOD if rate_hz >= 0.99 * target_hz else _STYLE_POOR


def _age(now_ns: int, stamp_ns: int | None) -> str:
    if stamp_ns is None:
        return f"{_NOT_MEASURED} ms"
    return f"{(now_ns - stamp_ns) / NS_PER_MS:.0f} ms"
