"""Table and verdicts shown on the terminal after a flight."""

from rich.table import Table
from rich.text import Text

from mavbridge.core.vehicle import LinkStats
from mavbridge.observe.timing import TimingReport

RELEASES_SHOWN = 3
_STYLE_GOOD, _STYLE_POOR, _STYLE_BAD = "green", "yellow", "red"
_LEGEND = (
    "stick lateness: from a slot of the stick grid to its send; a slot is missed when nothing was "
    "sent within one period. New attitude to wire: from the measurement of a new attitude to "
    "the first send of sticks based on it."
)


def timing_table(report: TimingReport) -> Table | None:
    """Return the measured percentiles of a flight in milliseconds; None if nothing was measured."""
    rows = {
        "stick lateness": report.sticks.lateness_ms,
        "chunk period": report.action.period_ms,
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
    """Return one line for each part of a flight, with its target and its result."""
    sticks, action, vision = report.sticks, report.action, report.vision
    missed = f"{_counted(sticks.missed_slots, 'slot')} of {sticks.slots} missed"
    style = _STYLE_GOOD if not sticks.missed_slots else _STYLE_POOR
    coasting = f"{_counted(sticks.coasting_sends, 'send')} coasting"
    text = f"{sticks.target_hz:g} Hz grid, {missed}, {coasting}"
    lines = [_line("sticks", text, style if sticks.slots else _STYLE_BAD)]
    late = f"{_counted(action.late_chunks, 'late chunk')} of {action.chunks}"
    dropped = "frames dropped by the camera not measured"
    if vision.dropped_frames is not None:
        dropped = f"{_counted(vision.dropped_frames, 'frame')} dropped by the camera"
    for name, loop, rest in (("action", action, late), ("vision", vision, dropped)):
        text = f"{number(loop.rate_hz, 1)} Hz of {loop.target_hz:.4g} Hz, {rest}"
        lines.append(_line(name, text, rate_style(loop.rate_hz, loop.target_hz)))
    if report.link is not None:
        lines.append(_line("link", _link_verdict(report.link)))
    lines.append(_line("releases", _release_verdict(report)))
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
        else f"{shown_share(link.lost_fraction, 2)} of the vehicle's messages lost"
    )
    sent = f"{_counted(link.sent_overrides, 'stick message')} sent"
    limits = "".join(
        f", {stick} beyond what the vehicle does in {shown_share(share, 1)}"
        for stick, share in link.saturated
    )
    return f"{sent}, {echo[link.echo_confirmed]}, {lost}{limits}"


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
        return _STYLE_BAD
    return _STYLE_GOOD if rate_hz >= 0.99 * target_hz else _STYLE_POOR
