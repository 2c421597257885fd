import json
from collections.abc import Callable
from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from benchmarks import compare
from benchmarks.compare import ratios, read_budget, violations
from benchmarks.results import BenchResult, print_result
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
        path.write_text(json.dumps({"ratios": {"toge, encode: torch / roofline f32": most}}))
        return path

    return write


@pytest.mark.usefixtures("canned")
@pytest.mark.parametrize(("most", "status"), [(3.1, 0), (2.9, 1)])
def test_exit_status_tells_whether_the_budget_holds(
    budget: Callable[[float], Path], capsys: pytest.CaptureFixture[str], most: float, status: int
) -> None:
    assert compare.main(check=budget(most)) == status
    out = capsys.readouterr().out
    assert ("over budget: toge, encode: torch / roofline f32: 3," in out) == bool(status)


@pytest.mark.usefixtures("canned")
def test_writes_json_into_a_folder_that_is_made(tmp_path: Path) -> None:
    path = tmp_path / "new" / "bench.json"
    assert compare.main(json=path) == 0
    assert json.loads(path.read_text())["machine"]["cpu"] == "some cpu"


@pytest.mark.usefixtures("forbidden")
@pytest.mark.parametrize("flag", ["json", "check"])
def test_what_cannot_be_used_is_refused_before_the_run(tmp_path: Path, flag: str) -> None:
    with pytest.raises(UserError):
        compare.main(**{flag: tmp_path})  # a folder


@pytest.mark.parametrize(
    "words",
    [
        *("some cpu", "60.00 / 61.00", "roofline bf16", "599 of 600", "0.60 / 0.60 / 0.60"),
        *("50.0 of 100", "25.0 of 100", "12 (0.100%)", "33"),
        *("201.0 of 200", "0.250 / 0.250 / 0.250", "7 of 3000"),
        *("400.0 / 400.0 / 400.0", "MAVSDK-Python 4: not measured"),
    ],
)
def test_tables_show_the_figures(words: str) -> None:
    buffer = StringIO()
    print_result(RESULT, Console(file=buffer, width=160))
    assert words in buffer.getvalue()
