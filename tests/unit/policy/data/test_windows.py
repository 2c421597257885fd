"""Windows of frames at an even pace, with the states and sticks that belong to them."""

from dataclasses import replace

import numpy as np
import pytest

from helpers.steered_flights import ACCELERATION_MPS2, MS, steered_flight
from policy.contract import QUATERNION, VELOCITY
from policy.data.flight_data import FlightData
from policy.data.windows import TOLERANCE, Windows, find_windows
from policy.errors import DatasetError

DT_NS = 100 * MS


def windows_of(*episodes: FlightData, dt_s: float = 0.1) -> Windows:
    return find_windows(episodes, context_frames=2, frames=4, frame_dt_s=dt_s)


def without(episode: FlightData, *dropped: int) -> FlightData:
    kept = np.setdiff1d(np.arange(len(episode.captured_ns)), dropped)
    return replace(episode, captured_ns=episode.captured_ns[kept], gate=episode.gate[kept])


def test_windows_stay_in_one_flight_and_cross_no_gap() -> None:
    first, second = steered_flight(0), steered_flight(1)
    gap = range(40, 47)
    found = windows_of(first, without(second, *gap))
    starts = found.frames[:, 0] >= 91
    assert (starts == (found.frames[:, -1] >= 91)).all()
    assert 0 < starts.sum() < 76
    captured_ns = np.concatenate([each.captured_ns for each in (first, without(second, *gap))])
    steps = np.diff(captured_ns[found.frames], axis=1)
    assert np.abs(steps - DT_NS).max() <= 2 * TOLERANCE * DT_NS
    in_second = captured_ns[found.frames[starts]]
    lost_ns = second.captured_ns[list(gap)].mean()
    assert not ((in_second[:, 0] < lost_ns) & (in_second[:, -1] > lost_ns)).any()


def test_actions_are_the_mean_of_what_was_sent_between_the_frames() -> None:
    flight = steered_flight(0)
    samples = windows_of(flight).at(np.array([0, 11]))
    assert samples.actions.shape == (2, 4, 4)
    for window in range(2):
        for index in range(4):
            start, stop = flight.captured_ns[samples.frames[window][index + 1 : index + 3]]
            at = np.arange(start, stop, MS // 10)
            sticks = flight.sent[np.searchsorted(flight.sent_ns, at, side="right") - 1]
            told = samples.actions[window, index]
            np.testing.assert_allclose(told, sticks.mean(axis=0), atol=2e-3)
    assert np.abs(samples.actions[..., 1]).max() > 0.1


def test_sticks_are_neutral_before_the_first_and_held_after_the_last() -> None:
    flight = steered_flight(0)
    late = replace(flight, sent_ns=flight.sent_ns[150:151], sent=np.ones((1, 4), np.float32))
    found = windows_of(late)
    ends = late.captured_ns[found.frames[:, 2:]]
    starts = late.captured_ns[found.frames[:, 1:-1]]
    assert (found.actions[ends <= late.sent_ns[0]] == 0).all()
    np.testing.assert_allclose(found.actions[starts >= late.sent_ns[0]], 1.0, atol=1e-6)


def test_states_are_those_of_the_exposures_and_follow_the_actions() -> None:
    flight = steered_flight(0)
    found = windows_of(flight)
    states = found.states[found.frames]
    lengths = np.linalg.norm(states[..., QUATERNION], axis=-1)
    np.testing.assert_allclose(lengths, 1.0, atol=1e-5)
    assert (states[..., QUATERNION.start] >= 0).all()
    moved = np.diff(states[:, 1:, VELOCITY], axis=1)
    elapsed_s = np.diff(flight.captured_ns[found.frames[:, 1:]], axis=1) / 1e9
    foretold = np.abs(found.actions[..., 2]) * elapsed_s * ACCELERATION_MPS2
    met = np.abs(np.linalg.norm(moved, axis=-1) - foretold) < 0.01 * ACCELERATION_MPS2
    assert met.mean() > 0.9  # not where it turns or changes its mind on the way


@pytest.mark.parametrize(
    ("every", "dt_s", "says"),
    [
        (1, 0.1, "steered 0: no 6 frames with states.*33 ms apart.: fly longer"),
        (2, 0.1, "66 ms apart.: fly longer, or record 10 images a second, or 20 and more"),
        (1, 0.02, "record 50 images a second, or 100 and more"),
    ],
)
def test_a_flight_without_a_window_is_refused(every: int, dt_s: float, says: str) -> None:
    flight = steered_flight(0, seconds=0.3 * every)
    with pytest.raises(DatasetError, match=says):
        windows_of(without(flight, *np.flatnonzero(np.arange(91) % every)), dt_s=dt_s)
