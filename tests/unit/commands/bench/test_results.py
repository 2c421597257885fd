import json
from collections.abc import Callable
from io import StringIO

import pytest
from rich.console import Console

from helpers.bench_results import RESULT, all_equal
from mavbridge.commands.bench.results import (
    LinkClient,
    flight_from_json,
    link_client_from_json,
    median_percentiles,
    to_json,
)
from mavbridge.commands.bench.tables import number, print_result, spread
from mavbridge.core.records import Percentiles


def test_a_flight_survives_the_way_between_processes() -> None:
    flight = RESULT.flights[0]
    assert flight_from_json(to_json(flight), flight.vehicle) == flight


@pytest.mark.parametrize("work", [None, all_equal(1.5)])
def test_a_link_client_survives_the_way_between_processes(work: Percentiles | None) -> None:
    told = LinkClient(state_to_wire_ms=all_equal(2.0), work_ms=work)
    assert link_client_from_json(to_json(told)) == told


def test_the_whole_result_is_json() -> None:
    document = json.loads(to_json(RESULT))
    assert document["kernels"][0]["p50_ms"] == 60.0
    assert document["top_rates"][0]["action_hz"] is None


def test_missed_fraction_is_of_the_asked_slots() -> None:
    assert RESULT.flights[0].missed_fraction == pytest.approx(12 / 6000)


def test_a_flight_of_no_length_missed_everything() -> None:
    document = json.loads(to_json(RESULT.flights[0])) | {"duration_s": 0.0}
    assert flight_from_json(json.dumps(document), None).missed_fraction == 1.0


def test_median_is_taken_percentile_by_percentile() -> None:
    found = (
        Percentiles(p50=1.0, p99=9.0, p999=9.0, max=20.0),
        Percentiles(p50=3.0, p99=5.0, p999=6.0, max=30.0),
        None,
        Percentiles(p50=2.0, p99=7.0, p999=8.0, max=10.0),
    )
    assert median_percentiles(found) == Percentiles(p50=2.0, p99=7.0, p999=8.0, max=20.0)


def test_median_of_nothing_is_nothing() -> None:
    assert median_percentiles([None, None]) is None


def printed() -> str:
    buffer = StringIO()
    print_result(RESULT, Console(file=buffer, width=160))
    return buffer.getvalue()


@pytest.mark.parametrize(
    "words",
    [
        *("some cpu", "60.00 / 70.00", "15.00 / 16.00", "roofline bf16", "5.00"),
        *(
            "50.0 of 100",
            "25.0 of 100",
            "12 (0.20%)",
            "inference 9, host 3",
            "400.0 / 400.0 / 400.0",
        ),
        *("under 25", "25 Hz: 50.00%", "250", "599 of 600", "0.60 / 0.60 / 0.60"),
        "MAVSDK-Python 4: not measured",
    ],
)
def test_tables_show_the_figures(words: str) -> None:
    assert words in printed()


def test_an_engine_that_cannot_do_a_piece_of_work_shows_a_dash() -> None:
    (row,) = (line for line in printed().splitlines() if line.startswith("│ sample │"))
    assert [cell.strip() for cell in row.strip("│").split("│")] == [
        *("sample", "18.00 / 20.00", "-", "3.00", "-"),
    ]


@pytest.mark.parametrize(
    ("show", "text"),
    [
        (lambda: number(None, 1), "-"),
        (lambda: number(1.25, 1), "1.2"),
        (lambda: spread(None), "-"),
        (lambda: spread(all_equal(0.5), 2), "0.50 / 0.50 / 0.50"),
    ],
)
def test_cells(show: Callable[[], str], text: str) -> None:
    assert show() == text
