from dataclasses import replace
from pathlib import Path

import cv2
import pytest

from helpers.bench_results import RESULT
from mavbridge.commands.bench.results import BenchResult

pytest.importorskip("matplotlib", reason="the figure needs the extra 'bench'")

NEVER_SENT = replace(
    RESULT, flights=tuple(replace(flight, state_to_wire_ms=None) for flight in RESULT.flights)
)


@pytest.mark.parametrize("result", [RESULT, NEVER_SENT])
def test_draws_what_there_is(tmp_path: Path, result: BenchResult) -> None:
    from mavbridge.commands.bench.figure import DOTS_PER_INCH, SIZE_INCHES, draw

    path = tmp_path / "bench.png"
    draw(result, path)
    height, width = cv2.imread(str(path)).shape[:2]
    assert (width, height) == tuple(round(side * DOTS_PER_INCH) for side in SIZE_INCHES)
