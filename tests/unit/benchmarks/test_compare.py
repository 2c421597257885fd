import json
import math
from pathlib import Path

import pytest

from benchmarks import compare
from benchmarks.compare import BenchResult, ratios, violations
from benchmarks.engines import EngineTiming
from benchmarks.link_vehicle import LinkLatency
from mavbridge.core.errors import UserError
from mavbridge.core.vehicle import Percentiles

QUICK = "toge, encode: quick / torch"
RESULT = BenchResult(
    engines=tuple(
        EngineTiming(policy="toge", work="encode", engine=engine, p50_ms=p50_ms, p99_ms=61.0)
        for engine, p50_ms in (("torch", 60.0), ("quick", 15.0))
    ),
    flight={
        "computer": {"cpu": "some cpu"},
        "timing": {
            "sticks": {"target_hz": 200.0, "lateness_ms": {"p50": 0.1, "p99": 0.25}},
            "action": {"target_hz": 100.0, "rate_hz": 50.0},
        },
        "cpu_cores": {"flight": 0.75, "guard": 0.125},
    },
    links=tuple(
        LinkLatency(
            client=client,
            sent=600,
            answered=599,
            round_trip_ms=Percentiles(p50=p50, p99=p50, p999=p50, max=p50),
        )
        for client, p50 in (("mavbridge", 0.6), ("bare pymavlink loop", 0.3))
    ),
    notes=("MAVSDK-Python 4: not measured, it is not installed",),
)


def test_ratios_compare_two_figures_of_one_run() -> None:
    expected = {
        QUICK: 0.25,
        "flight: period / asked period": 2.0,
        "flight: stick lateness p99 / period": 0.05,
        "flight: cores in all": 0.875,
        "flight: cores of the guard": 0.125,
        "link: mavbridge: round trip / bare pymavlink loop": 2.0,
    }
    assert ratios(RESULT) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("ratio", "most", "told"),
    [
        (QUICK, 0.26, None),
        (QUICK, 0.24, f"{QUICK}: 0.25, at most 0.24"),
        ("another", 1.0, "another: not measured"),
    ],
)
def test_exit_status_tells_whether_the_budget_holds(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    ratio: str,
    most: float,
    told: str | None,
) -> None:
    monkeypatch.setattr(compare, "measure", lambda: RESULT)
    monkeypatch.setattr(compare, "BUDGET", {ratio: most})
    figures = tmp_path / "new" / "bench.json"
    assert compare.main(json=figures) == (told is not None)
    out = capsys.readouterr().out
    assert (f"over budget: {told}" if told else "within the budget") in out
    for text in ("15.00 / 61.00", "599 of 600", "0.60 / 0.60 / 0.60", "not measured"):
        assert text in out
    assert json.loads(figures.read_text())["flight"]["computer"]["cpu"] == "some cpu"


def test_a_ratio_that_is_not_a_number_is_over_any_budget() -> None:
    assert violations({"a": math.nan}, {"a": 1.0})


def test_a_file_that_cannot_be_written_is_refused_before_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compare, "measure", lambda: pytest.fail("the benchmark ran"))
    with pytest.raises(UserError):
        compare.main(json=tmp_path)  # a folder
