from io import StringIO

import pytest
from rich.console import Console

from benchmarks.results import (
    BenchResult,
    print_result,
)
from helpers.bench_results import RESULT


def printed(result: BenchResult) -> str:
    buffer = StringIO()
    print_result(result, Console(file=buffer, width=160))
    return buffer.getvalue()


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
    assert words in printed(RESULT)
