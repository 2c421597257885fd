"""A benchmark's results as one picture: inference, rates, and latencies of flight and link."""

from collections.abc import Sequence
from math import floor, log10
from typing import NamedTuple

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from benchmarks.engines import EAGER
from benchmarks.results import OURS, BenchResult, EngineTiming, Flight
from mavbridge.commands.output import (
    BLUE,
    FIGURE_DPI,
    FIGURE_STYLE,
    GREY,
    INK,
    MUTED,
    PALE_BLUE,
    RED,
)

STYLE = FIGURE_STYLE | {"axes.grid.axis": "x", "axes.spines.left": False, "ytick.left": False}


class LatencyRow(NamedTuple):
    """A row of a latency panel, in ms."""

    label: str
    p50: float
    p99: float
    color: str


def make_figure(result: BenchResult) -> Figure:
    """Four panels, as high as their rows need."""
    with rc_context(STYLE):
        height = 5.0 + 0.65 * max(len(result.flights), len(result.links))
        figure = Figure(figsize=(12.0, height), dpi=FIGURE_DPI, facecolor="white")
        panels = figure.subplots(2, 2)
        draw_engines(panels[0][0], result.engines)
        draw_rates(panels[0][1], result.flights)
        flights = [
            LatencyRow(flight.label, latency.p50, latency.p99, _color(flight))
            for flight in result.flights
            if (latency := flight.state_to_wire_ms) is not None
        ]
        draw_latencies(panels[1][0], "Flying: attitude in to sticks out", flights)
        links = []
        for link in result.links:
            color = BLUE if link.client.startswith(OURS) else MUTED
            trip_ms = link.round_trip_ms
            links.append(LatencyRow(link.client, trip_ms.p50, trip_ms.p99, color))
        draw_latencies(panels[1][1], "Link alone: vehicle to vehicle", links)
        caption = (
            f"{result.machine.cpu}, {result.machine.cores} cores, which the simulated vehicle "
            "shares.\nLatency: dot = median, line to the 99th percentile, logarithmic."
        )
        figure.text(0.012, 0.012, caption, color=MUTED, fontsize=8.5)
        figure.tight_layout(rect=(0, 0.35 / height, 1, 1), w_pad=3, h_pad=2.5)
    return figure


def draw_engines(axes: Axes, timings: Sequence[EngineTiming]) -> None:
    """Bars for each piece of work, one for each engine; a line for a roofline."""
    works = tuple(dict.fromkeys((one.policy, one.work) for one in timings))
    names = tuple(dict.fromkeys(one.engine for one in timings))
    engines = [name for name in names if not name.startswith("roofline")]
    thickness = 0.8 / max(len(engines), 1)
    for name in names:
        found = [one for one in timings if one.engine == name]
        rows = [works.index((one.policy, one.work)) for one in found]
        times = [one.p50_ms for one in found]
        if name not in engines:
            tops, bottoms = [row - 0.4 for row in rows], [row + 0.4 for row in rows]
            style = "-" if name.endswith("f32") else ":"
            axes.vlines(times, tops, bottoms, color=RED, linestyle=style, label=name)
            continue
        centres = [row + (engines.index(name) + 0.5) * thickness - 0.4 for row in rows]
        color = PALE_BLUE if name == EAGER else BLUE
        bars = axes.barh(centres, times, 0.9 * thickness, color=color, label=name)
        axes.bar_label(bars, [_digits(time) for time in times], padding=4, fontsize=9, color=INK)
    labels = [_in_two_lines(f"{policy}, {work}") for policy, work in works]
    axes.set_yticks(range(len(works)), labels)
    axes.set_ylim(len(works) - 0.5, -0.5)
    axes.set_xlabel("ms, median")
    axes.margins(x=0.12)
    axes.set_title("Inference, one thread")
    axes.legend(loc="best")


def draw_rates(axes: Axes, flights: Sequence[Flight]) -> None:
    """Two bars for each flight: actions and images a second, and lines for what was asked."""
    for row, flight in enumerate(flights):
        for shift, kind, reached, asked in (
            (-0.19, "actions", flight.action_hz, flight.asked_action_hz),
            (0.19, "images", flight.vision_hz, flight.asked_vision_hz),
        ):
            bars = axes.barh(row + shift, reached or 0.0, 0.34, color=_color(flight))
            axes.bar_label(bars, [f"{reached or 0:.0f} {kind}"], padding=4, fontsize=9)
            axes.vlines(asked, row + shift - 0.17, row + shift + 0.17, color=RED)
    axes.set_yticks(range(len(flights)), [_in_two_lines(flight.label) for flight in flights])
    axes.set_ylim(len(flights) - 0.5, -0.5)
    axes.set_xlim(0, 1.35 * max((flight.asked_action_hz for flight in flights), default=1))
    axes.set_xlabel("Hz; red: what was asked for")
    axes.set_title("Rates")


def draw_latencies(axes: Axes, title: str, rows: Sequence[LatencyRow]) -> None:
    """A dot at each median and a line to the 99th percentile."""
    axes.set_title(title)
    if not rows:
        axes.set_axis_off()
        return
    for place, row in enumerate(rows):
        axes.plot([row.p50, row.p99], [place, place], color=row.color, linewidth=5, alpha=0.55)
        axes.plot(row.p50, place, "o", color=row.color, markersize=10)
        text = f"{_digits(row.p50)} ms  (p99 {_digits(row.p99)})"
        axes.annotate(text, (row.p50, place), (0, 10), textcoords="offset points", fontsize=9)
    low, high = min(row.p50 for row in rows), max(row.p99 for row in rows)
    room_for_text = 2 * (high / low) ** 0.35
    axes.set(xscale="log", xlabel="ms", xlim=(10 ** floor(log10(low)), high * room_for_text))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_yticks(range(len(rows)), [_in_two_lines(row.label) for row in rows])
    axes.set_ylim(len(rows) - 0.5, -0.6)


def _in_two_lines(label: str) -> str:
    parts = label.split(", ")
    half = len(parts) // 2
    return "\n".join((", ".join(parts[:half]), ", ".join(parts[half:]))).strip()


def _digits(value_ms: float) -> str:
    return f"{value_ms:.0f}" if value_ms >= 100 else f"{value_ms:.3g}"


def _color(flight: Flight) -> str:
    if flight.runner != OURS:
        return GREY
    return PALE_BLUE if flight.engine == EAGER else BLUE
