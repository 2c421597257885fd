"""What a person sees in the terminal: one line while flying, a table afterwards."""

from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from mavbridge.config.rates import STATUS_HZ
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.records import Event, LinkStats, Percentiles, Tick
from mavbridge.observe.timing import TimingReport

RATE_WINDOW_S = 1.0
PLAIN_PERIOD_S = 5.0
"""Between lines where there is no terminal to redraw one in."""
RELEASES_SHOWN = 3
MAX_NEWS = 100
"""Lines that may wait for the next refresh; the oldest give way."""
_NOT_MEASURED = "-"
_STYLE_GOOD, _STYLE_POOR, _STYLE_BAD = "green", "yellow", "red"


class _RateMeter:
    """Rate of a series of stamps, over the last ``RATE_WINDOW_S`` of refreshes."""

    def __init__(self) -> None:
        self._samples: deque[tuple[int, int]] = deque(maxlen=round(RATE_WINDOW_S * STATUS_HZ) + 1)
        self._newest = (0, 0)

    def count(self, stamp_ns: int) -> None:
        """One more event; count and stamp change in one step, since another thread reads them."""
        self._newest = (self._newest[0] + 1, stamp_ns)

    def sample_hz(self) -> float | None:
        """To be called once a refresh; None while nothing is coming."""
        if self._newest[0] == 0:
            return None
        self._samples.append(self._newest)
        (first, first_ns), (last, last_ns) = self._samples[0], self._samples[-1]
        if last_ns <= first_ns:
            return None
        return (last - first) * NS_PER_S / (last_ns - first_ns)


class StatusLine:
    """A ``TickSink`` that keeps the newest tick and turns it into one line."""

    def __init__(self, *, action_hz: float, vision_hz: float, readonly: bool) -> None:
        self._target_hz = (action_hz, vision_hz)
        self._readonly = readonly
        self._action, self._vision = _RateMeter(), _RateMeter()
        self._tick: Tick | None = None
        self._missed_slots = 0

    def emit(self, event: Event) -> None:
        """Remember the event."""
        if isinstance(event, Tick):
            self._tick = event
            self._missed_slots += event.missed_slots
            self._action.count(event.woke_ns)
        else:
            self._vision.count(event.ready_ns)

    def render(self) -> Text:
        """The line now; to be called at ``STATUS_HZ``, since the rates are averaged over calls."""
        rates_hz = (self._action.sample_hz(), self._vision.sample_hz())
        tick = self._tick
        if tick is None:
            return Text("waiting for the first tick", style="dim")
        attitude_ns = None if tick.state is None else tick.state.attitude_ns
        line = self._state(tick)
        line.append(f"  {tick.mode or 'mode unknown'} {'armed' if tick.armed else 'disarmed'}")
        for name, rate_hz, target_hz in zip(
            ("action", "vision"), rates_hz, self._target_hz, strict=True
        ):
            line.append(f"  {name} ")
            line.append(f"{_rate(rate_hz)} Hz", style=_rate_style(rate_hz, target_hz))
        line.append(f"  feature {_age(tick.sent_ns, tick.feature_captured_ns)}")
        line.append(f"  state {_age(tick.sent_ns, attitude_ns)}")
        line.append(f"  missed {self._missed_slots}")
        if tick.release_reason is not None:  # last: it may be long, and is cut first
            line.append(f"  {tick.release_reason}", style="yellow")
        line.no_wrap, line.overflow = True, "ellipsis"
        return line

    def _state(self, tick: Tick) -> Text:
        if tick.release_reason is not None:
            return Text("RELEASED", style="bold yellow")
        if self._readonly:
            return Text("READ-ONLY", style="bold cyan")
        return Text("FLYING" if tick.trace else "PREPARING", style="bold green")


class FlightScreen:
    """Status line and final table on one console; a ``TickSink``.

    ``emit`` is for the loops' threads, the rest for the main thread.
    """

    def __init__(
        self, console: Console, *, action_hz: float, vision_hz: float, readonly: bool
    ) -> None:
        self._console = console
        self._status = StatusLine(action_hz=action_hz, vision_hz=vision_hz, readonly=readonly)
        self._live = Live(console=console, auto_refresh=False, transient=True)
        self._refreshes = 0
        self._news: deque[str] = deque(maxlen=MAX_NEWS)
        self._activity: str | None = None

    def emit(self, event: Event) -> None:
        """Remember the event, and what in it is news to a person."""
        self._status.emit(event)
        if not isinstance(event, Tick):
            return
        self._news.extend(event.texts)
        if event.activity != self._activity:
            self._activity = event.activity
            self._news.append(event.activity)

    def tell(self, text: str) -> None:
        """Show a line with the next refresh; for any thread."""
        self._news.append(text)

    @contextmanager
    def live(self) -> Iterator[None]:
        """Show the status line, where there is a terminal, until the end of the block."""
        if not self._console.is_terminal:
            yield
            return
        with self._live:
            yield

    def refresh(self) -> None:
        """Print the news and redraw the line; to be called at ``STATUS_HZ``.

        Without a terminal: print it every ``PLAIN_PERIOD_S``.
        """
        self._print_news()
        line = self._status.render()
        self._refreshes += 1
        if self._console.is_terminal:
            self._live.update(line, refresh=True)
        elif self._refreshes % round(PLAIN_PERIOD_S * STATUS_HZ) == 0:
            self._console.print(line, soft_wrap=True)

    def _print_news(self) -> None:
        while self._news:
            self._console.print(Text(self._news.popleft()), soft_wrap=True)

    def show_report(self, report: TimingReport) -> None:
        """Print the last news, the table and the verdicts."""
        self._print_news()
        self._console.print(timing_table(report))
        for verdict in verdicts(report):
            self._console.print(verdict, soft_wrap=not self._console.is_terminal)


def timing_table(report: TimingReport) -> Table:
    """Percentiles of a flight in milliseconds."""
    peer = report.autopilot or "no vehicle"
    table = Table(
        title=f"{report.duration_s:.1f} s, {report.mode} rate: "
        f"{report.policy} on {report.engine}, {peer}",
        title_justify="left",
        title_style="bold",
    )
    table.add_column("ms")
    for name in ("p50", "p99", "p99.9", "max"):
        table.add_column(name, justify="right")
    rows = (
        ("action period", report.action.period_ms),
        ("action jitter |period - target|", report.action.jitter_ms),
        ("predict", report.action.predict_ms),
        ("vision encode", report.vision.encode_ms),
        ("feature age at send", report.feature_age_ms),
        ("attitude age at send", report.state_age_ms),
        ("new attitude to wire", report.state_to_wire_ms),
        ("link round trip", report.link.rtt_ms if report.link else None),
    )
    for label, measured in rows:
        table.add_row(label, *_cells(measured))
    return table


def verdicts(report: TimingReport) -> list[Text]:
    """One line for each part of a flight: what was asked, what came."""
    action, vision = report.action, report.vision
    lines = [
        _loop_verdict(
            "action",
            action.rate_hz,
            action.target_hz,
            f"{_counted(action.missed_slots, 'missed slot')} in {action.ticks} ticks",
        ),
        _loop_verdict(
            "vision",
            vision.rate_hz,
            vision.target_hz,
            f"{_counted(vision.dropped_frames, 'frame')} dropped by the camera",
        ),
    ]
    if report.link is not None:
        lines.append(_line("link", _link_verdict(report.link)))
    lines.append(_line("sticks", _release_verdict(report)))
    for name, drops in (
        ("rerun", report.observer_drops.rerun),
        ("recorder", report.observer_drops.recorder),
    ):
        if drops:
            lines.append(_line(name, f"missed {_counted(drops, 'event')}", _STYLE_POOR))
    return lines


def _loop_verdict(name: str, rate_hz: float | None, target_hz: float, rest: str) -> Text:
    return _line(
        name,
        f"{_rate(rate_hz)} of {target_hz:g} Hz asked, {rest}",
        _rate_style(rate_hz, target_hz),
    )


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
    return Text.assemble((f"{name:8}", "bold"), (text, style))


def _cells(measured: Percentiles | None) -> tuple[str, ...]:
    if measured is None:
        return (_NOT_MEASURED,) * 4
    values = (measured.p50, measured.p99, measured.p999, measured.max)
    return tuple(f"{value:.2f}" if value < 1000 else f"{value:.0f}" for value in values)


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
