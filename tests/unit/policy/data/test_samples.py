"""A policy is given in training what the runtime gives it in flight."""

from dataclasses import replace

import numpy as np
import pytest

from helpers.factories import about_z
from helpers.steered_flights import steered_flight
from mavbridge.core.records import VehicleState
from mavbridge.core.vehicle import Sticks
from mavbridge.flight.history import SentHistory
from mavbridge.flight.state import motion_since
from policy.contract import QUATERNION, RATE, SPECIFIC_FORCE, VELOCITY, Contract
from policy.data.flight_data import FlightData
from policy.data.samples import (
    BLIND_SHARE,
    FORCE_NOISE_MPS2,
    FRESH_START_SHARE,
    HISTORY_NOISE,
    RATE_NOISE_RADPS,
    Timeline,
    TrainingSamples,
)
from policy.errors import DatasetError
from policy.preprocess import egocentric_columns

MS = 1_000_000
CONTRACT = Contract(since_exposure=True, horizon=4)


def flown(ticks: int = 200, seed: int = 0, **changes: object) -> FlightData:
    """A restless flight at 100 Hz with true stamps that are never quite on the grid."""
    random = np.random.default_rng(seed)
    flight = steered_flight(seed, seconds=ticks / 100)
    tick_ns = flight.tick_ns + random.integers(0, MS, ticks)
    state = random.normal(0, 1, (ticks, 13)).astype(np.float32)
    state[:, VELOCITY] = np.cumsum(random.normal(0, 0.05, (ticks, 3)), axis=0)
    state[:, QUATERNION] = about_z(np.cumsum(random.normal(0, 0.02, ticks)))
    attitude_ns = tick_ns - random.integers(1, 5, ticks) * MS
    stamps = {"tick_ns": tick_ns, "attitude_ns": attitude_ns, "velocity_ns": attitude_ns - MS}
    flight = replace(
        flight,
        **stamps,
        state=state,
        target_ns=tick_ns,
        sent_ns=tick_ns + 2 * MS,
        target=np.cumsum(random.normal(0, 0.01, (ticks, 4)), axis=0).clip(-1, 1).astype("f4"),
        sent=random.uniform(-1, 1, (ticks, 4)).astype(np.float32),
        age_ns=np.array([40 * MS, 50 * MS, 90 * MS]),
    )
    return replace(flight, **changes)  # type: ignore[arg-type]


def timeline(*episodes: FlightData, contract: Contract = CONTRACT) -> Timeline:
    return Timeline(episodes, contract, np.sort(episodes[0].age_ns))


def test_history_is_what_the_runtime_resamples() -> None:
    episode = flown(ticks=60)
    made = timeline(flown(seed=1), episode).histories(np.arange(200, 260))
    runtime = SentHistory(CONTRACT)
    for tick in range(60):
        expected = runtime.resample(int(episode.tick_ns[tick]))
        np.testing.assert_array_equal(made[tick], expected[0])
        runtime.append(Sticks(*episode.sent[tick].tolist()), int(episode.sent_ns[tick]))


def test_the_runtime_finds_the_expert_in_a_chunk() -> None:
    """A row of a perfect chunk is the expert's stick of then."""
    episode = flown()
    line = timeline(episode)
    for tick in (20, 77, 130):
        chunk, known = line.chunks(np.array([tick]))
        assert known.all()
        for k in range(CONTRACT.horizon):
            at_s = k * CONTRACT.chunk_dt_s
            then_ns = episode.attitude_ns[tick] + round(at_s * 1e9)
            expert = [np.interp(then_ns, episode.target_ns, column) for column in episode.target.T]
            np.testing.assert_allclose(chunk[0, k], expert, atol=1e-6)


def test_a_chunk_beyond_the_end_holds_its_last_known_stick() -> None:
    line = timeline(flown())
    chunk, known = line.chunks(np.array([190]))
    assert known.tolist() == [[True, True, False, False]]
    np.testing.assert_array_equal(chunk[0, 2:], chunk[0, [1, 1]])


def test_a_chunk_needs_five_actions_a_second() -> None:
    """Rounded stamps of 5 Hz are at times more than 200 ms apart."""

    def slow(gap_ms: int) -> FlightData:
        at_ns = 10**9 + np.arange(0, 4000, gap_ms) * MS
        at_ns[1::2] += MS // 20
        return flown(400, target_ns=at_ns, target=np.zeros((len(at_ns), 4), np.float32))

    line = timeline(slow(200))
    assert line.chunks(np.arange(30, 300))[1].all()
    with pytest.raises(DatasetError, match="actions are 250 ms apart"):
        timeline(slow(250))


def test_the_runtime_gives_the_same_motion_since_exposure() -> None:
    episode = flown(ticks=60)
    line = timeline(episode)
    known: list[VehicleState] = []
    frames = np.arange(3, 19)
    for tick in range(60):
        state = VehicleState(
            values=episode.state[tick],
            attitude_ns=int(episode.attitude_ns[tick]),
            rate_ns=0,
            velocity_ns=int(episode.velocity_ns[tick]),
            specific_force_ns=0,
        )
        known.append(state)
        age_ns = episode.tick_ns[tick] - episode.captured_ns[frames]
        # Down to an image that is newer than the attitude of the tick.
        for frame in frames[(age_ns >= 0) & (age_ns < 200 * MS)]:
            motion = motion_since(int(episode.captured_ns[frame]), state, known)
            told = line.states(np.array([frame]), np.array([tick]))
            np.testing.assert_allclose(told[0], [*state.values, *motion], atol=1e-6)


def test_ticks_are_drawn_at_measured_ages() -> None:
    line = timeline(flown(), flown(seed=1))
    random = np.random.default_rng(0)
    frames = np.repeat(line.frames, 20)
    ticks = line.draw_ticks(frames, random)
    age_ms = (line.tick_ns[ticks] - line.captured_ns[frames]) / MS
    errors = np.abs(age_ms[:, None] - np.array([40, 50, 90])).min(axis=1)
    assert np.quantile(errors, 0.95) <= 6  # ticks are 10 ms apart; a flight ends before some ages
    assert age_ms.min() > 0
    near = np.abs(age_ms[:, None] - np.array([40, 90])) < 6
    assert near.mean(axis=0) == pytest.approx([1 / 3, 1 / 3], abs=0.08)


def test_of_rows_100_ms_apart_the_nearest_to_a_drawn_age_is_taken() -> None:
    """Not each time the first one after the exposure, as if no image were old."""
    flight = flown(600)
    names = ("tick_ns", "attitude_ns", "velocity_ns", "state")
    rows = {name: getattr(flight, name)[::10] for name in names}
    images = {"captured_ns": rows["tick_ns"], "gate": flight.gate[: len(rows["tick_ns"])]}
    line = timeline(replace(flight, **rows, **images, age_ns=np.arange(20, 91) * MS))
    frames = np.repeat(line.frames, 20)
    ticks = line.draw_ticks(frames, np.random.default_rng(0))
    age_ms = (line.tick_ns[ticks] - line.captured_ns[frames]) / MS
    assert age_ms.min() >= 0
    assert age_ms.max() <= 110
    assert age_ms.mean() == pytest.approx(55, abs=5)


def test_a_history_in_training_is_often_gone_and_never_exact() -> None:
    line = timeline(flown())
    ticks = np.full(4000, 100)
    plain, told = line.histories(ticks[:1]), line.histories(ticks, np.random.default_rng(0))
    newest_is_gone = (told[:, -1] == 0).all(axis=1)
    oldest_is_gone = (told[:, 0] == 0).all(axis=1)
    assert BLIND_SHARE < newest_is_gone.mean() < BLIND_SHARE + 0.1
    assert oldest_is_gone.mean() == pytest.approx(BLIND_SHARE + FRESH_START_SHARE, abs=0.05)
    newest = told[~oldest_is_gone][:, -1, 0]
    assert len(np.unique(newest)) > len(newest) / 2  # jitter alone would give two or three values
    assert np.quantile(np.abs(newest - plain[0, -1, 0]), 0.5) > HISTORY_NOISE / 4


def test_images_of_a_gate_behind_the_camera_are_left_out() -> None:
    usable = timeline(flown()).frames
    gate = np.full((len(flown().captured_ns), 7), np.nan, np.float32)
    gate[usable[2], 0], gate[usable[3], 0] = -0.5, 0.5
    left = timeline(flown(gate=gate)).frames
    assert left.tolist() == np.delete(usable, 2).tolist()


def test_a_mirrored_flight_is_seen_mirrored_from_the_vehicle() -> None:
    random = np.random.default_rng(4)
    state = random.normal(size=(30, 20)).astype(np.float32)
    state[:, QUATERNION] /= np.linalg.norm(state[:, QUATERNION], axis=1, keepdims=True)
    samples = TrainingSamples(
        state=state,
        history=random.normal(size=(30, 4, 4)).astype(np.float32),
        chunk=random.normal(size=(30, 4, 4)).astype(np.float32),
        known=np.ones((30, 4), bool),
        gate=random.normal(size=(30, 7)).astype(np.float32),
    )
    left = samples.mirrored(np.arange(30) % 2 == 0)
    np.testing.assert_array_equal(left.state[1::2], samples.state[1::2])
    vector, turn = (1, -1, 1), (-1, 1, -1)
    signs = [*vector, *vector, *turn, *vector, 1, *turn, *vector]
    seen, mirrored = (
        np.transpose(egocentric_columns(each.state[::2].T)) for each in (samples, left)
    )
    np.testing.assert_allclose(mirrored, seen * signs, atol=1e-5)
    np.testing.assert_array_equal(left.chunk[::2], samples.chunk[::2] * [1, -1, 1, -1])
    np.testing.assert_array_equal(left.gate[::2], samples.gate[::2] * [*vector, -1, *vector])


def test_rates_and_forces_are_noisy_in_training_by_rates_alone() -> None:
    """Rates and forces, nothing else of the state, and only for rates."""
    by_rates = Contract(since_exposure=True, horizon=4, action="rates")
    ticks, frames = np.full(400, 60), np.full(400, 15)
    for contract, flight, is_hidden in (
        (by_rates, flown(contract=by_rates), True),
        (CONTRACT, flown(), False),
    ):
        timeline = Timeline([flight], contract, np.array([40 * MS]))
        plain = timeline.samples(frames, ticks)
        trained = timeline.samples(frames, ticks, np.random.default_rng(1))
        change = trained.state - plain.state
        for part, spread in ((RATE, RATE_NOISE_RADPS), (SPECIFIC_FORCE, FORCE_NOISE_MPS2)):
            assert change[:, part].std() == pytest.approx(spread if is_hidden else 0.0, rel=0.1)
            change[:, part] = 0.0
        assert not change.any()
