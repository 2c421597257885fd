from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from helpers.bench_results import RESULT

figure = pytest.importorskip(
    "mavbridge.commands.bench.figure", reason="the figure needs the extra 'bench'"
)


@pytest.fixture
def axes() -> Iterator[object]:
    from matplotlib.figure import Figure

    return Figure().subplots()


def test_bars_and_rooflines_are_the_medians(axes) -> None:
    figure.draw_engines(axes, RESULT.engines)
    assert sorted(bar.get_width() for bar in axes.patches) == [15.0, 18.0, 60.0]
    lines = {
        lines.get_label(): sorted(segment[0][0] for segment in lines.get_segments())
        for lines in axes.collections
    }
    assert lines == {"roofline f32": [3.0, 20.0], "roofline bf16": [5.0]}


def test_rates_are_drawn_beside_what_was_asked(axes) -> None:
    figure.draw_rates(axes, RESULT.flights)
    assert [bar.get_width() for bar in axes.patches] == [50.0, 15.0, 25.0, 15.0]
    asked = [lines.get_segments()[0][0][0] for lines in axes.collections]
    assert asked == [100.0, 30.0, 100.0, 30.0]
    labels = [label.get_text().split("\n")[0] for label in axes.get_yticklabels()]
    assert labels == ["mavbridge, toge:small", "baseline, toge:small"]


def test_latencies_run_from_the_median_to_the_99th_percentile(axes) -> None:
    span = figure.LatencyRow("one, two", 2.0, 30.0, "black")
    figure.draw_spans(axes, "title", [span])
    line, dot = axes.lines
    assert list(line.get_xdata()) == [2.0, 30.0]
    assert list(dot.get_xdata()) == [2.0]
    low, high = axes.get_xlim()
    assert low <= 2.0
    assert high > 30.0


def test_a_flight_that_sent_nothing_has_no_latency(tmp_path: Path) -> None:
    flights = tuple(replace(flight, state_to_wire_ms=None) for flight in RESULT.flights)
    assert figure.flight_spans(flights) == []
    figure.draw(replace(RESULT, flights=flights), tmp_path / "bench.png")
    assert (tmp_path / "bench.png").exists()


def test_every_client_has_its_round_trip() -> None:
    spans = figure.link_spans(RESULT.links)
    assert [(span.label, span.p50) for span in spans] == [
        ("mavbridge, 100 Hz clock", 5.0),
        ("bare pymavlink loop", 0.3),
    ]
