"""A benchmark run as one picture: inference, rates, latency of the loop, latency of the link."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from mavbridge.commands.bench.engines import EAGER
from mavbridge.commands.bench.flights import NAIVE_NAME, OURS_NAME
from mavbridge.commands.bench.results import BenchResult, Flight

INK, MUTED, GRID = "#1f2933", "#6b7885", "#dfe4ea"
THEIRS = "#a9b4bf"
ACCENT = "#d1495b"
OURS = ("#9cc5e8", "#2b6cb0", "#1a365d")
"""An engine each, the eager one the palest."""
SIZE_INCHES = (12.0, 10.4)
DOTS_PER_INCH = 150
STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 10,
    "text.color": INK,
    "axes.labelcolor": MUTED,
    "axes.edgecolor": GRID,
    "axes.titlesize": 12,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlepad": 14,
    "axes.grid": True,
    "axes.grid.axis": "x",
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.spines.left": False,
    "grid.color": GRID,
    "xtick.color": MUTED,
    "ytick.color": INK,
    "ytick.left": False,
    "legend.frameon": False,
    "legend.fontsize": 9,
}


class _Span(NamedTuple):
    """A row of a latency panel, in ms."""

    label: str
    p50: float
    p99: float
    color: str


def draw(result: BenchResult, path: Path) -> None:
    """Write the PNG."""
    with rc_context(STYLE):
        figure = Figure(figsize=SIZE_INCHES, dpi=DOTS_PER_INCH, facecolor="white")
        panels = figure.subplots(2, 2)
        _draw_kernels(panels[0][0], result)
        _draw_rates(panels[0][1], result)
        flights = [_flight_span(flight) for flight in result.flights if flight.state_to_wire_ms]
        _draw_spans(panels[1][0], "Flying: attitude in to sticks out", flights)
        _draw_spans(panels[1][1], "Link alone: vehicle to vehicle", _links(result))
        machine = result.machine
        figure.text(
            *(0.012, 0.012),
            f"{machine.cpu}, {machine.cores} cores; EfficientNet-B3 at 224 pixels, and ResNet-8 at "
            "96 in the policy that ships; the simulated vehicle flies on the same cores.\n"
            "Latency: dot = median, line to the 99th percentile, logarithmic.",
            color=MUTED,
            fontsize=8.5,
        )
        figure.tight_layout(rect=(0, 0.035, 1, 1), w_pad=3, h_pad=2.5)
        figure.savefig(path)


def _draw_kernels(axes: Axes, result: BenchResult) -> None:
    """Bars by work and engine; a tick where the roofline of the fastest precision is."""
    engines = tuple(dict.fromkeys(kernel.engine for kernel in result.kernels))
    works = tuple(dict.fromkeys(kernel.work for kernel in result.kernels))
    thickness = 0.8 / max(len(engines), 1)
    for index, engine in enumerate(engines):
        found = [kernel for kernel in result.kernels if kernel.engine == engine]
        rows = [works.index(kernel.work) + (index + 0.5) * thickness - 0.4 for kernel in found]
        times = [kernel.p50_ms for kernel in found]
        bars = axes.barh(rows, times, 0.9 * thickness, color=_color(index), label=engine)
        axes.bar_label(bars, [_digits(time) for time in times], padding=4, fontsize=9, color=INK)
    for precision, style in (("f32", "-"), ("bf16", ":")):
        for number, roof in enumerate(
            roof for roof in result.rooflines if roof.precision == precision
        ):
            row = works.index(roof.work)
            label = f"roofline {precision}" if number == 0 else None
            axes.plot([roof.floor_ms] * 2, [row - 0.4, row + 0.4], style, color=ACCENT, label=label)
    axes.set_yticks(range(len(works)), [_in_two_lines(work) for work in works])
    axes.set_ylim(len(works) - 0.5, -0.5)
    axes.set_xlabel("ms, median")
    axes.margins(x=0.1)
    axes.set_title("Inference, one thread")
    axes.legend(loc="best")


def _in_two_lines(work: str) -> str:
    return work.replace(" (", "\n(")


def _draw_rates(axes: Axes, result: BenchResult) -> None:
    """What was reached of what was asked; and the highest rate that is kept."""
    flights = result.flights
    for row, flight in enumerate(flights):
        for shift, reached, asked in (
            (-0.19, flight.action_hz, flight.asked_action_hz),
            (0.19, flight.vision_hz, flight.asked_vision_hz),
        ):
            kind = "actions" if shift < 0 else "images"
            bars = axes.barh(row + shift, reached or 0.0, 0.34, color=_flight_color(flight))
            axes.bar_label(bars, [f"{reached or 0:.0f} {kind}"], padding=4, fontsize=9)
            axes.plot([asked] * 2, [row + shift - 0.17, row + shift + 0.17], color=ACCENT)
    labels = [_flight_label(flight) for flight in flights]
    axes.set_yticks(range(len(flights)), labels)
    axes.set_ylim(len(flights) - 0.5, -0.5)
    axes.set_xlim(0, 1.25 * max((flight.asked_action_hz for flight in flights), default=1))
    axes.set_xlabel("Hz; red: what was asked for")
    best = max((top.action_hz for top in result.top_rates if top.action_hz), default=None)
    axes.set_title("Rates" + (f" ({best:g} Hz with < 0.1 % missed)" if best else ""))


def _flight_label(flight: Flight) -> str:
    return f"{flight.runner}\n{flight.label}".replace(", ", "\n")


def _draw_spans(axes: Axes, title: str, spans: Sequence[_Span]) -> None:
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
    axes.set_xlim(low / 1.6, 2 * high * (high / low) ** 0.35)  # room for the words at the right
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set_yticks(range(len(spans)), [span.label for span in spans])
    axes.set_ylim(len(spans) - 0.5, -0.6)
    axes.set_xlabel("ms")


def _digits(value_ms: float) -> str:
    return f"{value_ms:.0f}" if value_ms >= 100 else f"{value_ms:.3g}"


def _flight_span(flight: Flight) -> _Span:
    latency = flight.state_to_wire_ms
    if latency is None:
        raise ValueError("a flight without latency cannot be drawn")
    return _Span(_flight_label(flight), latency.p50, latency.p99, _flight_color(flight))


def _links(result: BenchResult) -> list[_Span]:
    return [
        _Span(
            link.client.replace(", ", "\n"),
            link.round_trip_ms.p50,
            link.round_trip_ms.p99,
            OURS[1] if link.client.startswith(OURS_NAME) else MUTED,
        )
        for link in result.links
    ]


def _flight_color(flight: Flight) -> str:
    if flight.runner == NAIVE_NAME:
        return THEIRS
    return OURS[0] if flight.engine == EAGER else OURS[1]


def _color(index: int) -> str:
    return OURS[min(index, len(OURS) - 1)]
