import json
from pathlib import Path

import pytest

from benchmarks.compare import ratios, read_budget, violations
from helpers.bench_results import RESULT
from mavbridge.core.errors import UserError

FLOWN = next(flight for flight in RESULT.flights if flight.runner == "mavbridge")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("toge, encode: torch / roofline f32", 3.0),
        ("toge, sample: torch / roofline f32", 6.0),
        ("toge, encode: quick / roofline f32", 0.75),
        ("toge, encode: quick / torch", 0.25),
        ("flight: toge:small, 1 step, torch: period / asked period", 2.0),
        ("flight: toge:small, 1 step, torch: period / baseline", 0.5),
        ("flight: toge:small, 1 step, torch: cpu an action / baseline", 0.5),
        ("flight: toge:small, 1 step, torch: state to wire / baseline", 0.05),
        ("flight: toge:small, 1 step, torch: stick lateness p99 / period", 0.05),
        ("flight: toge:small, 1 step, torch: cores in all", FLOWN.cpu_cores),
        ("flight: toge:small, 1 step, torch: cores of the guard", 0.125),
        ("link: mavbridge: round trip / bare pymavlink loop", 2.0),
    ],
)
def test_ratios_compare_two_figures_of_one_run(name: str, value: float) -> None:
    assert ratios(RESULT)[name] == pytest.approx(value)
    assert len(ratios(RESULT)) == 12


def test_reads_what_the_repository_holds() -> None:
    path = Path(__file__).parents[3] / "benchmarks" / "budget.json"
    budget = read_budget(path)
    assert budget == json.loads(path.read_text())["ratios"]
    assert all(most > 0 for most in budget.values())


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"ratios": {"a": "b"}}', '{"ratios": [1]}'])
def test_refuses_what_is_no_budget(tmp_path: Path, text: str) -> None:
    path = tmp_path / "budget.json"
    path.write_text(text)
    with pytest.raises(UserError, match=r"budget\.json"):
        read_budget(path)


@pytest.mark.parametrize(
    ("found", "most", "lines"),
    [
        ({"a": 1.0, "b": 2.0}, {"a": 1.0, "b": 2.5}, []),
        ({"a": 1.5, "b": 2.0}, {"a": 1.0, "b": 2.5}, ["a: 1.5"]),
        ({"b": 2.0}, {"a": 1.0}, ["a: not measured"]),
        ({"a": float("nan")}, {"a": 1.0}, ["a: "]),
    ],
)
def test_what_got_worse_or_was_not_measured_is_named(
    found: dict[str, float], most: dict[str, float], lines: list[str]
) -> None:
    told = violations(found, most)
    assert len(told) == len(lines)
    assert all(text.startswith(line) for text, line in zip(told, lines, strict=True))
