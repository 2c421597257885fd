"""Alignment: whatever the stamps, a row knows nothing that had not arrived at its exposure."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from helpers.flight_folders import LEVEL, MS
from mavbridge.commands.export import (
    MAX_HELD_NS,
    Stretch,
    common_fps,
    stretches,
    worst_shift_ns,
)
from policy.contract import Contract
from policy.data import lerobot_format as names
from policy.data.flight_data import GATE_DIM, FlightData


def episode(
    captured_ms: list[int],
    tick_ms: list[int],
    *,
    lag_ms: int = 0,
    unknown: frozenset[int] = frozenset(),
    sent_ms: list[int] | None = None,
) -> FlightData:
    captured = np.array(captured_ms, np.int64) * MS
    ticks = np.array(tick_ms, np.int64) * MS
    sent = np.array(tick_ms if sent_ms is None else sent_ms, np.int64) * MS
    state = np.tile(np.array(LEVEL, np.float32), (len(ticks), 1))
    state[:, 0] = np.arange(len(ticks)) / 100
    state[[k for k in unknown if k < len(ticks)]] = np.nan
    return FlightData(
        name="a flight",
        contract=Contract(),
        tick_ns=ticks,
        state=state,
        attitude_ns=ticks - lag_ms * MS,
        velocity_ns=ticks - lag_ms * MS,
        target_ns=ticks,
        target=np.zeros((len(ticks), 4), np.float32),
        sent_ns=sent,
        sent=np.full((len(sent), 4), 0.5, np.float32),
        age_ns=np.array([], np.int64),
        captured_ns=captured,
        gate=np.full((len(captured), GATE_DIM), np.nan, np.float32),
        decode=lambda: iter(()),
    )


increasing = st.lists(st.integers(1, 60), min_size=2, max_size=60).map(
    lambda steps: np.cumsum(steps).tolist()
)


@given(increasing, increasing, st.integers(0, 30), st.frozensets(st.integers(0, 59)))
def test_a_row_holds_what_had_arrived(
    captured_ms: list[int], tick_ms: list[int], lag_ms: int, unknown: frozenset[int]
) -> None:
    flight = episode(captured_ms, tick_ms, lag_ms=lag_ms, unknown=unknown)
    end = -1
    for part in stretches(flight):
        assert part.first_frame > end
        end = part.first_frame + len(part) - 1
        assert len(part) >= 2
        np.testing.assert_array_equal(
            part.captured_ns, flight.captured_ns[part.first_frame : end + 1]
        )
        assert np.isfinite(part.columns[names.STATE_KEY]).all()
        for stamps in (
            part.columns[names.ATTITUDE],
            part.columns[names.VELOCITY],
            part.columns[names.ACTED],
        ):
            assert (stamps <= part.captured_ns).all()
            assert (part.captured_ns - stamps <= MAX_HELD_NS).all()
        later = flight.attitude_ns[None] > part.columns[names.ATTITUDE][:, None]
        assert not (later & (flight.attitude_ns[None] <= part.captured_ns[:, None])).any()


def test_a_hole_in_the_camera_makes_two_and_one_frame_does_not() -> None:
    ticks = list(range(0, 2000, 10))
    even = list(range(100, 1500, 33))
    one = [at for at in even if at != even[10]]
    two = [at for at in even if at not in even[10:12]]
    assert [len(part) for part in stretches(episode(one, ticks))] == [len(even) - 1]
    assert [len(part) for part in stretches(episode(two, ticks))] == [10, len(even) - 12]


def test_before_anything_was_sent_sticks_are_neutral() -> None:
    (part,) = stretches(episode([50, 83, 116], list(range(0, 200, 10)), sent_ms=[100]))
    np.testing.assert_array_equal(part.columns[names.SENT][:, 0], np.array([0, 0, 0.5], np.float32))
    np.testing.assert_array_equal(part.columns[names.SENT_AT], np.array([50, 83, 100]) * MS)


def parts(*periods: list[int]) -> list[Stretch]:
    ticks = list(range(0, 5000, 10))
    return [stretches(episode(np.cumsum([100, *p]).tolist(), ticks))[0] for p in periods]


def test_the_rate_is_the_mean_where_no_frame_is_missing() -> None:
    (part,) = parts([32, 32, 36] * 10 + [66])
    assert common_fps([part]) == 30
    # the frames that come after the missing one are a period late
    assert 30 * MS < worst_shift_ns(part, 30) < 40 * MS


def test_a_stretch_of_a_few_hurried_frames_has_the_rate_of_its_flight() -> None:
    captured = np.cumsum([100, *[33] * 100, 300, 20]).tolist()
    both = stretches(episode(captured, list(range(0, 5000, 10))))
    assert [len(part) for part in both] == [101, 2]
    assert common_fps(both) == 30
