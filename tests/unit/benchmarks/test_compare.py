import json
from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks import compare
from benchmarks.compare import BenchResult, ratios, read_budget, violations
from benchmarks.engines import EngineTiming
from benchmarks.link_vehicle import LinkLatency
from mavbridge.core.errors import UserError
from mavbridge.core.vehicle import Percentiles

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


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("toge, encode: quick / torch", 0.25),
        ("flight: period / asked period", 2.0),
        ("flight: stick lateness p99 / period", 0.05),
        ("flight: cores in all", 0.875),
        ("flight: cores of the guard", 0.125),
        ("link: mavbridge: round trip / bare pymavlink loop", 2.0),
    ],
)
def test_ratios_compare_two_figures_of_one_run(name: str, value: float) -> None:
    assert ratios(RESULT)[name] == pytest.approx(value)
    assert len(ratios(RESULT)) == 6


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


@pytest.fixture
def canned(monkeypatch: pytest.MonkeyPatch) -> None:
    """A run that takes no time."""
    monkeypatch.setattr(compare, "measure", lambda: RESULT)


@pytest.fixture
def forbidden(monkeypatch: pytest.MonkeyPatch) -> None:
    """A run that must not begin."""

    def measure() -> BenchResult:
        return pytest.fail("the benchmark ran before its arguments were looked at")

    monkeypatch.setattr(compare, "measure", measure)


@pytest.fixture
def budget(tmp_path: Path) -> Callable[[float], Path]:
    def write(most: float) -> Path:
        path = tmp_path / "budget.json"
        path.write_text(json.dumps({"ratios": {"toge, encode: quick / torch": most}}))
        return path

    return write


@pytest.mark.usefixtures("canned")
@pytest.mark.parametrize(("most", "status"), [(0.26, 0), (0.24, 1)])
def test_exit_status_tells_whether_the_budget_holds(
    budget: Callable[[float], Path], capsys: pytest.CaptureFixture[str], most: float, status: int
) -> None:
    assert compare.main(check=budget(most)) == status
    out = capsys.readouterr().out
    assert ("over budget: toge, encode: quick / torch: 0.25," in out) == bool(status)
    for figures in ("15.00 / 61.00", "599 of 600", "0.60 / 0.60 / 0.60", "not measured"):
        assert figures in out


@pytest.mark.usefixtures("canned")
def test_writes_json_into_a_folder_that_is_made(tmp_path: Path) -> None:
    path = tmp_path / "new" / "bench.json"
    assert compare.main(json=path) == 0
    assert json.loads(path.read_text())["flight"]["computer"]["cpu"] == "some cpu"


@pytest.mark.usefixtures("forbidden")
@pytest.mark.parametrize("flag", ["json", "check"])
def test_what_cannot_be_used_is_refused_before_the_run(tmp_path: Path, flag: str) -> None:
    with pytest.raises(UserError):
        compare.main(**{flag: tmp_path})  # a folder
