from collections.abc import Iterator
from dataclasses import replace

import pytest

from helpers.bench_results import RESULT

figure = pytest.importorskip("benchmarks.figure", reason="the figure needs the extra 'bench'")


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
    figure.draw_latencies(axes, "title", [span])
    line, dot = axes.lines
    assert list(line.get_xdata()) == [2.0, 30.0]
    assert list(dot.get_xdata()) == [2.0]
    low, high = axes.get_xlim()
    assert low <= 2.0
    assert high > 30.0


def test_every_client_has_its_round_trip_and_a_flight_that_sent_nothing_no_latency() -> None:
    flights = tuple(replace(flight, state_to_wire_ms=None) for flight in RESULT.flights)
    flying, links = figure.make_figure(replace(RESULT, flights=flights)).axes[2:]
    assert not flying.lines
    labels = [label.get_text().replace("\n", ", ") for label in links.get_yticklabels()]
    assert [label.lstrip(", ") for label in labels] == [link.client for link in RESULT.links]
    assert [line.get_xdata()[0] for line in links.lines[::2]] == [0.6, 0.3]
