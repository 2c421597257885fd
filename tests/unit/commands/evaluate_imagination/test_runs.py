"""Which frames are evaluated, and that it is their images that are."""

from pathlib import Path

import numpy as np
import pytest

from helpers.recordings import make_meta
from helpers.rollouts import TINY, grey, write_flight
from mavbridge.commands.evaluate_imagination.runs import (
    chain_steps,
    find_folders,
    read_runs,
    spread,
    survey,
    with_images,
)
from mavbridge.core.errors import UserError
from policy.contract import Contract


def test_runs_are_spread_evenly_over_all_flights() -> None:
    rows = spread([10, 0, 30], 5)
    assert [r.tolist() for r in rows] == [[0, 9], [], [9, 19, 29]]
    assert [r.tolist() for r in spread([2, 1], 64)] == [[0, 1], [0]]
    assert [r.tolist() for r in spread([0, 0], 4)] == [[], []]


def test_a_flight_is_surveyed(tmp_path: Path) -> None:
    folder = write_flight(tmp_path / "flight", seconds=4.0)
    found = survey(folder, TINY, exe_steps=4, iterations=10)
    assert found is not None
    # 18 frames 0.1 s apart span 51 of the 30 Hz camera's; those after the last tick have no state.
    assert 120 - 51 - 4 <= found.windows <= 120 - 51
    # 4 s hold 40 frames: 2 + 16 + 4 (n - 1) of them for n = 6.
    assert found.chain_iterations == 6
    assert 0 < found.chains_of(6) < found.windows
    assert found.chains_of(5) == 0


def test_a_flight_too_short_for_one_window_is_none(tmp_path: Path) -> None:
    folder = write_flight(tmp_path / "flight", seconds=1.5)
    assert survey(folder, TINY, exe_steps=16, iterations=10) is None


def test_a_flight_of_another_frame_is_refused(tmp_path: Path) -> None:
    meta = make_meta(contract=Contract(state_frame="enu_flu"))
    folder = write_flight(tmp_path / "flight", seconds=3.0, meta=meta)
    with pytest.raises(UserError, match="enu_flu, the world model takes ned_frd"):
        survey(folder, TINY, exe_steps=16, iterations=10)


def test_each_run_gets_its_own_images_though_they_overlap(tmp_path: Path) -> None:
    folder = write_flight(tmp_path / "flight", seconds=4.0)
    rows = np.array([0, 1, 7, 40])
    runs = read_runs(folder, TINY, TINY.frames, rows)
    wanted = [0, 1, 2, 5, 17]
    seen = list(with_images(runs, wanted, TINY.image_size))
    assert [run for run, _ in seen] == runs
    for row, (run, images) in zip(rows, seen, strict=True):
        assert run.frames[:3].tolist() == [row, row + 3, row + 6]
        assert sorted(images) == wanted
        for step, image in images.items():
            assert image.shape == (32, 32, 3)
            assert abs(float(image.mean()) - grey(int(run.frames[step]))) < 3
        assert run.at_s == pytest.approx(np.arange(18) / 10, abs=1e-6)
        # What was sent is 1 / 1000 a tick: its mean from frame to frame lies between.
        assert run.actions[0, 1] == pytest.approx((run.frames[1] + 1.5) / 30 / 10, abs=0.002)


def test_a_chain_needs_the_sticks_of_its_last_iteration() -> None:
    assert chain_steps(TINY, 16, 10) == 160
    assert chain_steps(TINY, 4, 3) == 24


def test_failed_demonstrations_are_left_out(tmp_path: Path) -> None:
    write_flight(tmp_path / "a")
    write_flight(tmp_path / "b", meta=make_meta(source="demonstration", success=False))
    folders, failed = find_folders([tmp_path])
    assert [folder.name for folder in folders] == ["a"]
    assert failed == 1
