import json
import re
from dataclasses import replace
from io import StringIO
from pathlib import Path

import cv2
import pytest
from rich.console import Console

from helpers.bench_results import RESULT
from mavbridge.commands.bench.rollout import print_result
from mavbridge.commands.bench.rollout_results import (
    Comparison,
    RolloutBench,
    Trial,
    Way,
    to_json,
    typical,
)


def make_trial(way: Way, *, iterations: int = 8, steps: int = 4, wall_s: float = 10.0) -> Trial:
    return Trial(
        way=way,
        device="cpu",
        iterations=iterations,
        ddim_steps=steps,
        torch_threads=2 if way == "serial" else 1,
        frames=16 * iterations,
        frames_decoded=(32 if way == "serial" else 16) * iterations,
        wall_s=wall_s,
        start_s=0.0 if way == "serial" else 1.5,
        sample_s=6.0,
        decode_s=3.0,
        write_s=1.0,
        peak_rss_mb=321.0,
        writer_rss_mb=None if way == "serial" else 123.0,
        peak_gpu_mb=None,
        sha256="0" * 64,
    )


def make_pair(iterations: int = 8, steps: int = 4) -> Comparison:
    return Comparison(
        serial=make_trial("serial", iterations=iterations, steps=steps),
        streamed=make_trial("streamed", iterations=iterations, steps=steps, wall_s=8.0),
    )


ROLLOUTS = RolloutBench(
    machine=RESULT.machine,
    quick=True,
    world_model="random weights",
    frames=16,
    exe_steps=1,
    by_iterations=(make_pair(8), make_pair(64)),
    by_steps=(make_pair(steps=1), make_pair(steps=4)),
)


def shown(result: RolloutBench) -> str:
    text = StringIO()
    print_result(result, Console(file=text, width=140))
    return text.getvalue()


def test_speed_up_and_bound_are_ratios_of_wall_and_sampling() -> None:
    pair = make_pair()
    assert pair.speed_up == pytest.approx(1.25)
    assert pair.bound == pytest.approx(10 / 6)


def test_the_median_run_counts() -> None:
    trials = [make_trial("serial", wall_s=wall_s) for wall_s in (3.0, 1.0, 2.0)]
    assert typical(trials).wall_s == 2.0
    assert typical(trials[:2]).wall_s == 1.0


def test_the_tables_show_both_ways_and_no_gpu_where_there_is_none() -> None:
    text = shown(ROLLOUTS)
    for part in ("serial", "streamed", "321", "123", "1.25", "1.67", "threads", "1024"):
        assert part in text
    assert re.search(r"serial +│ +8 │ +2 │ +256 ", text), "two threads"
    assert re.search(r"streamed +│ +8 │ +1 │ +128 ", text), "one thread"
    assert "all 4 pairs have the same frames" in text
    assert "GPU" not in text


def test_a_gpu_has_columns_of_its_own_and_different_frames_are_told() -> None:
    pair = make_pair()
    on_gpu = replace(pair.streamed, device="cuda", peak_gpu_mb=777.0, sha256="1" * 64)
    text = shown(replace(ROLLOUTS, by_iterations=(replace(pair, streamed=on_gpu),)))
    assert "777" in text
    assert "cuda" in text
    assert "did not give the same frames" in text


def test_the_json_holds_what_follows_from_the_figures() -> None:
    document = json.loads(to_json(ROLLOUTS))
    first = document["by_steps"][0]
    assert (first["speed_up"], first["bound"], first["is_exact"]) == (1.25, 1.6667, True)
    assert first["streamed"]["frames_decoded"] == 128


def test_the_figure_is_drawn(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="the figure needs the extra 'bench'")
    from mavbridge.commands.bench.figure import DOTS_PER_INCH
    from mavbridge.commands.bench.rollout_figure import SIZE_INCHES, draw

    draw(ROLLOUTS, tmp_path / "a.png")
    height, width = cv2.imread(str(tmp_path / "a.png")).shape[:2]
    assert (width, height) == tuple(round(side * DOTS_PER_INCH) for side in SIZE_INCHES)
