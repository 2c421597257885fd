from dataclasses import replace

import pytest

from helpers.bench_results import RESULT

figure = pytest.importorskip("benchmarks.figure", reason="the figure needs the extra 'bench'")


def test_every_client_has_its_round_trip_and_a_flight_that_sent_nothing_no_latency() -> None:
    flights = tuple(replace(flight, state_to_wire_ms=None) for flight in RESULT.flights)
    flying, links = figure.make_figure(replace(RESULT, flights=flights)).axes[2:]
    assert not flying.lines
    labels = [label.get_text().replace("\n", ", ") for label in links.get_yticklabels()]
    assert [label.lstrip(", ") for label in labels] == [link.client for link in RESULT.links]
    assert [line.get_xdata()[0] for line in links.lines[::2]] == [0.6, 0.3]
