import json
from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks import compare
from benchmarks.results import BenchResult
from helpers.bench_results import RESULT
from mavbridge.core.errors import UserError


@pytest.fixture
def canned(monkeypatch: pytest.MonkeyPatch) -> None:
    """A run that takes no time."""
    monkeypatch.setattr(compare, "measure", lambda *_, **__: RESULT)


@pytest.fixture
def forbidden(monkeypatch: pytest.MonkeyPatch) -> None:
    """A run that must not begin."""

    def measure(*_: object, **__: object) -> BenchResult:
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
    budget: Callable[[float], Path],
    capsys: pytest.CaptureFixture[str],
    most: float,
    status: int,
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
