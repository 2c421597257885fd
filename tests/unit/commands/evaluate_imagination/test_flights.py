"""Which windows are evaluated, and that their images are their own."""

from pathlib import Path

import numpy as np
import pytest

from helpers.recordings import make_meta
from helpers.rollouts import TINY, grey, write_flight
from mavbridge.commands.evaluate_imagination.flights import (
    choose_windows,
    read_episode,
    with_images,
)
from mavbridge.core.errors import UserError
from policy.contract import Contract


@pytest.fixture(scope="module")
def flights(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    root = tmp_path_factory.mktemp("flights")
    return [write_flight(root / name, seconds=s) for name, s in (("a", 4), ("b", 1.5), ("c", 3))]


def test_windows_are_spread_evenly_over_the_flights_that_have_any(flights: list[Path]) -> None:
    episodes = [read_episode(folder, TINY) for folder in flights]
    every, count = choose_windows(episodes, TINY, steps=16, count=10_000)
    assert count == 2
    # 18 frames 0.1 s apart span 51 of the 30 Hz camera's; those after the last tick have no state.
    for folder, frames in ((flights[0], 120), (flights[2], 90)):
        found = [window.frames[0] for window in every if window.folder == folder]
        assert found == list(range(len(found)))
        assert frames - 51 - 4 <= len(found) <= frames - 51
    few, count = choose_windows(episodes, TINY, steps=16, count=3)
    assert count == 2
    picked = [0, (len(every) - 1) // 2, len(every) - 1]
    expected = [(every[k].folder, every[k].frames[0]) for k in picked]
    assert [(window.folder, window.frames[0]) for window in few] == expected


def test_flights_that_are_too_short_have_no_windows(flights: list[Path]) -> None:
    episodes = [read_episode(flights[1], TINY)]
    assert choose_windows(episodes, TINY, steps=16, count=5) == ([], 0)
    assert choose_windows([], TINY, steps=16, count=5) == ([], 0)


def test_a_flight_of_another_frame_is_refused(tmp_path: Path) -> None:
    meta = make_meta(contract=Contract(state_frame="enu_flu"))
    folder = write_flight(tmp_path / "flight", seconds=0.2, meta=meta)
    with pytest.raises(UserError, match="enu_flu, the world model takes ned_frd"):
        read_episode(folder, TINY)


def test_each_window_gets_its_own_images_though_they_overlap(flights: list[Path]) -> None:
    episodes = [read_episode(folder, TINY) for folder in flights]
    every, _ = choose_windows(episodes, TINY, steps=16, count=10_000)
    chosen = [every[k] for k in (0, 1, 7, 40, len(every) - 1)]
    wanted = [0, 1, 2, 5, 17]
    seen = list(with_images(chosen, wanted, TINY.image_size))
    assert [window for window, _ in seen] == chosen
    for window, images in seen:
        assert np.diff(window.frames).tolist() == [3] * 17
        assert sorted(images) == wanted
        for step, image in images.items():
            assert image.shape == (32, 32, 3)
            assert abs(float(image.mean()) - grey(int(window.frames[step]))) < 3
        # What was sent is 1 / 1000 a tick: its mean from frame to frame lies between.
        assert window.actions[0, 1] == pytest.approx((window.frames[1] + 1.5) / 300, abs=0.002)
