"""A benchmark's results as one picture: inference, rates, and latencies of flight and link."""

from collections.abc import Sequence
from math import floor, log10
from pathlib import Path
from typing import NamedTuple

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from mavbridge.commands.bench.engines import EAGER
from mavbridge.commands.bench.results import OURS, BenchResult, EngineTiming, Flight, LinkLatency
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


def draw(result: BenchResult, path: Path) -> None:
    """Write the PNG, as high as its rows need."""
    with rc_context(STYLE):
        height = 5.0 + 0.65 * max(len(result.flights), len(result.links))
        figure = Figure(figsize=(12.0, height), dpi=FIGURE_DPI, facecolor="white")
        panels = figure.subplots(2, 2)
        draw_engines(panels[0][0], result.engines)
        draw_rates(panels[0][1], result.flights)
        flights = flight_spans(result.flights)
        draw_spans(panels[1][0], "Flying: attitude in to sticks out", flights)
        draw_spans(panels[1][1], "Link alone: vehicle to vehicle", link_spans(result.links))
        caption = (
            f"{result.machine.cpu}, {result.machine.cores} cores, which the simulated vehicle "
            "shares.\nLatency: dot = median, line to the 99th percentile, logarithmic."
        )
        figure.text(0.012, 0.012, caption, color=MUTED, fontsize=8.5)
        figure.tight_layout(rect=(0, 0.35 / height, 1, 1), w_pad=3, h_pad=2.5)
        figure.savefig(path)


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


def draw_spans(axes: Axes, title: str, spans: Sequence[LatencyRow]) -> None:
    """A dot at each median and a line to the 99th percentile."""
    axes.set_title(title)
    if not spans:
        axes.set_axis_off()
        return
    for row, span in enumerate(spans):
        axes.plot([span.p50, span.p99], [row, row], color=span.color, linewidth=5, alpha=0.55)
        axes.plot(span.p50, row, "o", color=span.color, markersize=10)
        text = f"{_digits(span.p50)} ms  (p99 {_digits(span.p99)})"
        axes.annotate(
            text, (span.p50, row), (0, 10), textcoords="offset points", ha="left", fontsize=9
        )
    axes.set_xscale("log")
    low, high = min(span.p50 for span in spans), max(span.p99 for span in spans)
    axes.set_xlim(
        10 ** floor(log10(low)), 2 * high * (high / low) ** 0.35
    )  # room for the words at the right
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set_yticks(range(len(spans)), [_in_two_lines(span.label) for span in spans])
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_ylim(len(spans) - 0.5, -0.6)
    axes.set_xlabel("ms")


def flight_spans(flights: Sequence[Flight]) -> list[LatencyRow]:
    """Latencies of the flights that sent sticks."""
    return [
        LatencyRow(flight.label, latency.p50, latency.p99, _color(flight))
        for flight in flights
        if (latency := flight.state_to_wire_ms) is not None
    ]


def link_spans(links: Sequence[LinkLatency]) -> list[LatencyRow]:
    """Round trips of all clients."""
    return [
        LatencyRow(
            link.client,
            link.round_trip_ms.p50,
            link.round_trip_ms.p99,
            BLUE if link.client.startswith(OURS) else MUTED,
        )
        for link in links
    ]


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
