"""Terminal output of a flight: one status line while flying, a table afterwards."""

import logging
import threading
from collections import deque
from contextlib import AbstractContextManager, ExitStack, nullcontext
from typing import NamedTuple

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.log import SAID, is_log_thread
from mavbridge.core.provenance import without_secrets
from mavbridge.core.records import Event, Tick
from mavbridge.core.stopping import HungError, Worker
from mavbridge.core.vehicle import LinkStats
from mavbridge.observe.keyboard import ignore_job_control
from mavbridge.observe.output import PatientOutput, stray_lines_shown
from mavbridge.observe.timing import TimingReport

_said = logging.getLogger(SAID)
STATUS_HZ = 5.0
"""Refresh rate of the terminal."""
RATE_WINDOW_S = 1.0
ACTIVITY_SPACING_NS = NS_PER_S
PLAIN_PERIOD_S = 5.0
"""Interval between lines if the output is not a terminal."""
MAX_MESSAGES = 100
"""Most messages that wait to be printed; then the oldest are dropped and counted."""
RELEASES_SHOWN = 3
GOOD, POOR, BAD = "green", "yellow", "red"
_LEGEND = (
    "stick lateness: from a slot of the stick grid to its send; a slot is missed when nothing was "
    "sent within one period. New attitude to wire: from the measurement of a new attitude to "
    "the first send of sticks based on it."
)


class RateMeter:
    """Rate of a series of stamps over the last ``RATE_WINDOW_S`` of refreshes."""

    def __init__(self) -> None:
        self._samples: deque[tuple[int, int]] = deque(maxlen=round(RATE_WINDOW_S * STATUS_HZ) + 1)
        self._newest = (0, 0)

    def count(self, stamp_ns: int) -> None:
        """Count an event. Count and stamp change in one step because another thread reads them."""
        self._newest = (self._newest[0] + 1, stamp_ns)

    def sample_hz(self) -> float | None:
        """Return events per second, or None while no events come. Call once per refresh."""
        if self._newest[0] == 0:
            return None
        self._samples.append(self._newest)
        (first, first_ns), (last, last_ns) = self._samples[0], self._samples[-1]
        return (last - first) * NS_PER_S / (last_ns - first_ns) if last_ns > first_ns else None


class MessageScreen:
    """Shows messages, and what else this process prints, on one console.

    Between ``start`` and ``close`` only the screen's own thread writes to the console. A stalled
    reader (Ctrl-S, a pipe that nothing empties) blocks only that thread. All methods return at
    once, except for ``close``, which has a deadline. They can be called by any thread.
    """

    def __init__(self, console: Console) -> None:
        """Show messages on ``console``, for a stalled reader a ``patient_console``."""
        self._console = console
        self._messages: deque[tuple[RenderableType, bool]] = deque(maxlen=MAX_MESSAGES)
        """Messages, and whether the terminal wraps their lines."""
        self._dropped = 0
        self._worker: Worker | None = None
        self._redirection = ExitStack()

    def start(self) -> None:
        """Start the display."""
        output = self._console.file
        if isinstance(output, PatientOutput):
            self._redirection.enter_context(stray_lines_shown(self._show_stray, output))
        self._worker = Worker("mavbridge-terminal", self._run)
        self._worker.start()

    def close(self, timeout_s: float) -> None:
        """Print pending messages and the report, and stop. Works twice, and without ``start``.

        Text that the reader did not take within the timeout is dropped; do not use standard error
        afterwards, which would block, too (``end_process``).
        """
        worker, self._worker = self._worker, None
        self._redirection.close()
        if worker is None:
            if not self._messages:
                return
            worker = Worker("mavbridge-terminal", self._run)
            worker.start()
        try:
            worker.join(timeout_s)
        except HungError:
            if isinstance(self._console.file, PatientOutput):
                self._console.file.give_up()
                worker.ends_within(timeout_s)

    def show_message(self, text: str, style: str = "") -> None:
        """Log a message now, and show it with the next refresh."""
        _said.info("%s", text)
        self._put(Text(without_secrets(text), style=style))

    def _put(self, message: RenderableType, *, soft_wrap: bool = True) -> None:
        if len(self._messages) == MAX_MESSAGES:
            self._dropped += 1  # two threads at once can lose one count
        self._messages.append((message, soft_wrap))

    def _print_messages(self) -> None:
        dropped, self._dropped = self._dropped, 0
        if dropped:
            self._console.print(Text(f"({dropped} older messages were dropped)"), soft_wrap=True)
        while self._messages:
            message, soft_wrap = self._messages.popleft()
            self._console.print(message, soft_wrap=soft_wrap)

    def _show_stray(self, text: str) -> None:
        """Show a line printed elsewhere in the process; lines of the log are already logged."""
        if not is_log_thread():
            _said.info("%s", text)
        self._put(Text(without_secrets(text), style="dim"))

    def _run(self, stop: threading.Event) -> None:
        while not stop.wait(1 / STATUS_HZ):
            self._print_messages()
        self._print_messages()


class FlightScreen(MessageScreen):
    """``TickSink`` that also shows a status line and a final table.

    All ticks must come from one thread, and all vision ticks from one thread.
    """

    def __init__(
        self, console: Console, *, action_hz: float, vision_hz: float, readonly: bool
    ) -> None:
        super().__init__(console)
        self._target_hz = (action_hz, vision_hz)
        self._readonly = readonly
        self._hint: str | None = None
        self._action, self._vision = RateMeter(), RateMeter()
        self._tick: Tick | None = None
        self._missed_slots = 0
        self._activity_ns = 0
        self._stage: tuple[object, ...] = ()
        self._refreshes = 0
        # Not Live's own redirection: any printing thread would wait for the console's lock.
        self._live = Live(
            console=console,
            auto_refresh=False,
            transient=True,
            redirect_stdout=False,
            redirect_stderr=False,
        )

    def start(self, *, hint: str | None = None) -> None:
        """Start the display. ``hint`` names the keys and their actions; None: no keys."""
        self._hint = hint
        if hint is not None and not self._console.is_terminal:
            self.show_message(hint)
        super().start()

    def emit(self, event: Event) -> None:
        """Store the event and its messages."""
        if not isinstance(event, Tick):
            self._vision.count(event.ready_ns)
            return
        if self._tick is None or event.chunk_serial != self._tick.chunk_serial:
            self._action.count(event.woke_ns)
        self._missed_slots += event.missed_slots
        for text in event.texts:
            self.show_message(text)
        self._show_activity(event)
        self._tick = event

    def _show_activity(self, tick: Tick) -> None:
        """Show a change of control. A reason that keeps changing is shown at most once a second."""
        before = self._tick
        if before is not None:
            is_other = before.phase != tick.phase or before.holder != tick.holder
            is_due = tick.woke_ns - self._activity_ns >= ACTIVITY_SPACING_NS
            if tick.stage == self._stage or not (is_other or is_due):
                return
        self._stage, self._activity_ns = tick.stage, tick.woke_ns
        self.show_message(tick.activity)

    def show_report(self, report: TimingReport) -> None:
        """Show the table of measurements and the findings with the next refresh."""
        if (table := timing_table(report)) is not None:
            self._put(table, soft_wrap=False)
        for finding in findings(report):
            _said.info("%s", finding.line.plain)
            self._put(finding.line, soft_wrap=not self._console.is_terminal)

    def status_line(self) -> Text:
        """Return the current status. Call at ``STATUS_HZ``: rates are averages over calls."""
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
            if name == "action" and tick.chunk_serial is None:
                continue  # the policy may still compute, but does not fly
            line.append(f"  {name} ")
            line.append(f"{number(rate_hz, 1)} Hz", style=rate_style(rate_hz, target_hz))
        attitude_ns = None if tick.state is None else tick.state.attitude_ns
        line.append(f"  feature {age(tick.sent_ns, tick.feature_captured_ns)}")
        line.append(f"  state {age(tick.sent_ns, attitude_ns)}")
        line.append(f"  missed {self._missed_slots}")
        if tick.release_reason is not None:  # last: it can be long, and is cut first
            line.append(f"  {without_secrets(str(tick.release_reason))}", style="yellow")
        return line

    def _state(self, tick: Tick) -> tuple[str, str]:
        if tick.release_reason is not None:
            return tick.holder, "bold yellow"
        if self._readonly:
            return "READ-ONLY", "bold cyan"
        if tick.is_coasting:
            return "COASTING", "bold yellow"
        return "FLYING" if tick.trace else "PREPARING", "bold green"

    def _run(self, stop: threading.Event) -> None:
        ignore_job_control()
        with self.live():
            while not stop.wait(1 / STATUS_HZ):
                self.refresh()
        self._print_messages()

    def live(self) -> AbstractContextManager[object]:
        """Context manager: show the status line if there is a terminal."""
        return self._live if self._console.is_terminal else nullcontext()

    def refresh(self) -> None:
        """Print new messages and the status line; without a terminal, the line less often.

        During a flight only the screen's own thread calls this, at ``STATUS_HZ``.
        """
        self._print_messages()
        line = self.status_line()
        self._refreshes += 1
        if self._console.is_terminal:
            shown = line if self._hint is None else Group(line, Text(self._hint, style="dim"))
            self._live.update(shown, refresh=True)
        elif self._refreshes % round(PLAIN_PERIOD_S * STATUS_HZ) == 0:
            self._console.print(line, soft_wrap=True)


def age(now_ns: int, stamp_ns: int | None) -> str:
    """Return the age of a stamp in milliseconds, for the status line."""
    age_ms = None if stamp_ns is None else (now_ns - stamp_ns) / NS_PER_MS
    return f"{number(age_ms, 0)} ms"


def timing_table(report: TimingReport) -> Table | None:
    """Return the measured percentiles of a flight in milliseconds; None if nothing was measured."""
    rows = report.times_ms
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


class Finding(NamedTuple):
    """Result of one part of a flight."""

    name: str
    text: str
    style: str = ""
    """``GOOD``, ``POOR`` or ``BAD``; empty: neither."""

    @property
    def line(self) -> Text:
        """Return the line of the terminal."""
        return Text.assemble((f"{self.name:8} ", "bold"), (self.text, self.style))


def findings(report: TimingReport) -> list[Finding]:
    """Return a finding on each part of a flight, with its target and its result."""
    sticks, action, vision = report.sticks, report.action, report.vision
    missed = f"{_counted(sticks.missed_slots, 'slot')} of {sticks.slots} missed"
    style = GOOD if not sticks.missed_slots else POOR
    coasting = f"{_counted(sticks.coasting_sends, 'send')} coasting"
    text = f"{sticks.target_hz:g} Hz grid, {missed}, {coasting}"
    lines = [Finding("sticks", text, style if sticks.slots else BAD)]
    late = f"{_counted(action.late_chunks, 'late chunk')} of {action.chunks}"
    dropped = "frames dropped by the camera not measured"
    if vision.dropped_frames is not None:
        dropped = f"{_counted(vision.dropped_frames, 'frame')} dropped by the camera"
    for name, loop, rest in (("action", action, late), ("vision", vision, dropped)):
        text = f"{number(loop.rate_hz, 1)} Hz of {loop.target_hz:.4g} Hz, {rest}"
        lines.append(Finding(name, text, rate_style(loop.rate_hz, loop.target_hz)))
    if report.link is not None:
        lines.append(Finding("link", _link_text(report.link)))
    lines.append(Finding("releases", _release_text(report)))
    drops = {"rerun": report.observer_drops.rerun, "recorder": report.observer_drops.recorder}
    lines += [
        Finding(name, f"missed {_counted(count, 'event')}", POOR)
        for name, count in drops.items()
        if count
    ]
    return lines


def _link_text(link: LinkStats) -> str:
    echo = {True: "echo confirmed", False: "NO ECHO from the vehicle", None: "echo not checked"}
    lost = (
        "loss not measured"
        if link.lost_fraction is None
        else f"{shown_share(link.lost_fraction, 2)} of the vehicle's messages lost"
    )
    sent = f"{_counted(link.sent_actions, 'command')} sent"
    return f"{sent}, {echo[link.echo_confirmed]}, {lost}"


def _release_text(report: TimingReport) -> str:
    if not report.releases:
        return "never released"
    last = report.releases[-RELEASES_SHOWN:]
    shown = "; ".join(f"{release.reason} ({release.t_s:.1f} s)" for release in last)
    more = "last " if report.release_count > len(last) else ""
    return f"released {_counted(report.release_count, 'time')}, {more}for: {shown}"


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


def number(value: float | None, digits: int) -> str:
    """Format a figure; a dash if it was not measured."""
    return "-" if value is None else f"{value:.{digits}f}"


def shown_share(share: float, digits: int) -> str:
    """Format a fraction as per cent; a small one, which would read as zero, by its bound."""
    least = 10.0 ** -(2 + digits)
    bound = f"under {least:.{digits}%}"
    return bound if 0 < share < least / 2 else f"{share:.{digits}%}"


def rate_style(rate_hz: float | None, target_hz: float) -> str:
    """Return the colour of a rate: green from 99 % of its target, yellow from 90 %."""
    if rate_hz is None or rate_hz < 0.9 * target_hz:
        return BAD
    return GOOD if rate_hz >= 0.99 * target_hz else POOR
