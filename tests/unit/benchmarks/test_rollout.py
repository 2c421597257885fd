import re
from io import StringIO

import pytest
from rich.console import Console

from benchmarks.rollout import Pair, print_pairs
from benchmarks.rollout_process import Trial
from mavbridge.commands.output import PIPED_WIDTH


def make_trial(way: str, *, iterations: int = 8, steps: int = 4, wall_s: float = 10.0) -> Trial:
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
        peak_rss_mb=321.0 + iterations,
        writer_rss_mb=None if way == "serial" else 123.0,
        sha256="0" * 64,
    )


def make_pair(iterations: int = 8, steps: int = 4) -> Pair:
    return Pair(
        serial=make_trial("serial", iterations=iterations, steps=steps),
        streamed=make_trial("streamed", iterations=iterations, steps=steps, wall_s=8.0),
    )


BY_ITERATIONS = (make_pair(8), make_pair(64))
BY_STEPS = (make_pair(steps=1), make_pair(steps=4))


def printed(*pairs: Pair) -> str:
    text = StringIO()
    print_pairs(pairs, Console(file=text, width=PIPED_WIDTH))
    return text.getvalue()


def test_speed_up_and_bound_are_ratios_of_wall_and_sampling() -> None:
    assert make_pair().speed_up == pytest.approx(1.25)
    assert make_pair().bound == pytest.approx(10 / 6)


def test_the_table_shows_both_ways() -> None:
    text = printed(*BY_ITERATIONS, *BY_STEPS)
    assert re.search(r"serial +│ +8 │ +4 │ +256 ", text)
    assert re.search(r"streamed +│ +8 │ +4 │ +128 ", text)
    for part in ("329", "123", "1.25", "1.67", "0 of 4 pairs differ in their frames"):
        assert part in text
