from dataclasses import replace
from io import StringIO

import pytest
from rich.console import Console

from benchmarks.results import (
    BenchResult,
    ClientTiming,
    Flight,
    from_json,
    name_of,
    print_result,
    solves_of,
    to_json,
)
from helpers.bench_results import RESULT, all_equal, make_flight
from mavbridge.config.policy import PolicyConfig
from mavbridge.core.vehicle import Percentiles


@pytest.mark.parametrize("flight", RESULT.flights)
def test_a_flight_survives_the_way_between_processes(flight: Flight) -> None:
    assert from_json(Flight, to_json(flight)) == flight


@pytest.mark.parametrize("last_part", [None, all_equal(1.5)])
def test_a_client_survives_the_way_between_processes(last_part: Percentiles | None) -> None:
    timing = ClientTiming(state_to_wire_ms=all_equal(2.0), chunk_to_wire_ms=last_part)
    assert from_json(ClientTiming, to_json(timing)) == timing


def test_missed_fraction_is_of_the_asked_slots() -> None:
    assert RESULT.flights[0].missed_fraction == pytest.approx(12 / 12_000)
    assert make_flight("mavbridge", duration_s=0.0).missed_fraction == 1.0


@pytest.mark.parametrize(
    ("changes", "solves"),
    [
        ({"dual_rate": False}, "single rate, 1 step"),
        ({}, "1 step"),
        ({"dual_rate": True, "num_diffusion_steps": 3}, "3 steps"),
    ],
)
def test_a_policy_is_named_with_its_kind_of_solve(changes: dict[str, int], solves: str) -> None:
    assert name_of(PolicyConfig(**changes)) == "toge"
    assert solves_of(PolicyConfig(**changes)) == solves


def printed(result: BenchResult) -> str:
    buffer = StringIO()
    print_result(result, Console(file=buffer, width=160))
    return buffer.getvalue()


@pytest.mark.parametrize(
    "words",
    [
        *("some cpu", "60.00 / 61.00", "roofline bf16", "599 of 600", "0.60 / 0.60 / 0.60"),
        *("50.0 of 100", "25.0 of 100", "12 (0.100%)", "kernel 9, host 3"),
        *("201.0 of 200", "0.250 / 0.250 / 0.250", "7 of 3000"),
        *("400.0 / 400.0 / 400.0", "10.0 / 11.0 / 12.0", "MAVSDK-Python 4: not measured"),
    ],
)
def test_tables_show_the_figures(words: str) -> None:
    assert words in printed(RESULT)


def test_work_that_an_engine_cannot_do_shows_a_dash() -> None:
    (row,) = (line for line in printed(RESULT).splitlines() if "│ sample │" in line)
    cells = [cell.strip() for cell in row.strip("│").split("│")]
    assert cells == ["toge", "sample", "18.00 / 19.00", "-", "3.00 / 4.00", "-"]


def test_what_the_vehicle_never_saw_shows_a_dash() -> None:
    silent = replace(RESULT, flights=(make_flight("mavbridge", vehicle_gap_ms=None),))
    (row,) = (line for line in printed(silent).splitlines() if "gaps at the vehicle" in line)
    assert row.strip("│").split("│")[1].strip() == "-"
