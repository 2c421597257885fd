"""The map of two rates: every loop gets what its encoder leaves it, and nothing is flown twice."""

import json
from pathlib import Path

import pytest

from benchmarks import two_rates
from benchmarks.two_rates import CONTROLS, ENCODER_MS, LOOPS, Cell, Control, Loop, flags_of


def made(control: Control, loop: Loop, encoder_ms: int, weights: Path, episodes: int) -> Cell:
    return Cell(
        control=control.name,
        loop=loop,
        encoder_ms=encoder_ms,
        command="mavbridge evaluate",
        checkpoint_sha256=two_rates.sha256(weights),
        episodes=episodes,
        success=0.5,
        success_low=0.4,
        success_high=0.6,
        gates=6.0,
        speed_mps=8.0,
    )


def test_a_single_loop_waits_for_its_encoder_and_two_rates_do_not() -> None:
    assert "--single-rate --set-config rates.single=18.52" in flags_of("one rate", 50)
    assert "--single-rate --set-config rates.single=100 " in flags_of("one rate", 5)
    assert "rates.visual=20 --set-config rates.action=100" in flags_of("100 actions a second", 50)
    assert "rates.visual=30 --set-config rates.action=250" in flags_of("250 actions a second", 5)


def test_an_interrupted_map_resumes_and_other_weights_begin_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, flown = tmp_path / "map.json", []
    weights, races = tmp_path / "sticks.safetensors", tmp_path / "rates.safetensors"
    weights.write_text("weights")
    races.write_text("weights of races")

    def evaluate(
        control: Control, loop: Loop, encoder_ms: int, weights: Path, episodes: int, _workers: int
    ) -> Cell:
        if len(flown) == most:
            raise KeyboardInterrupt
        flown.append((control, loop, encoder_ms))
        return made(control, loop, encoder_ms, weights, episodes)

    monkeypatch.setattr(two_rates, "evaluate", evaluate)
    most = 4
    with pytest.raises(KeyboardInterrupt):
        two_rates.main(json=out, sticks=weights, rates=races)
    most = 1000
    two_rates.main(json=out, sticks=weights, rates=races)
    controls = CONTROLS
    assert flown == [(each, loop, ms) for each in controls for ms in ENCODER_MS for loop in LOOPS]
    assert len(json.loads(out.read_text())) == len(flown)
    races.write_text("other weights")
    two_rates.main(json=out, sticks=weights, rates=races)
    assert len(flown) == (len(CONTROLS) + 1) * len(ENCODER_MS) * len(LOOPS)


def test_the_figure_shows_every_cell(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="the figure needs the extra 'bench'")
    weights = tmp_path / "weights"
    weights.write_text("")
    cells = [
        made(control, loop, ms, weights, 50)
        for control in CONTROLS
        for ms in ENCODER_MS
        for loop in LOOPS
    ]
    two_rates.draw(cells, tmp_path / "map.png")
    assert (tmp_path / "map.png").stat().st_size > 10_000
