"""From a recorded flight to the start of a rollout, and what a decider observes."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers.factories import START_NS
from helpers.rollouts import (
    SIZE,
    TINY,
    TinyWorld,
    grey,
    make_plan,
    make_sampler,
    make_start,
    noise_runner,
    write_flight,
)
from mavbridge.commands.imagine import read_start
from mavbridge.commands.imagine_rollout import ObservationQueue, PolicyDecider, rollout
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.errors import UserError
from mavbridge.core.records import FloatArray, ImageArray
from mavbridge.recording.flight_folder import open_flight
from mavbridge.simulation.clock import SteppedClock
from policy.contract import Contract


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_flight(tmp_path_factory.mktemp("flight") / "a")


def test_context_is_a_frame_each_frame_dt_with_the_state_at_its_exposure(flight: Path) -> None:
    start = read_start(open_flight(flight), TINY, 0.4)
    assert start.images.shape == (2, SIZE, SIZE, 3)
    # 0.4 s and 0.5 s at 30 Hz
    np.testing.assert_allclose(start.images.mean(axis=(1, 2, 3)), [grey(12), grey(15)], atol=3)
    np.testing.assert_allclose(start.states[:, 0], [0.40, 0.50], atol=0.011)
    assert start.newest_ns == START_NS + NS_PER_S // 2
    at_ns, sticks = start.sent[-1]
    assert START_NS + 490 * NS_PER_MS <= at_ns < start.newest_ns
    assert sticks.yaw == pytest.approx(0.049)


def test_the_vehicle_flew_on_by_the_action_before_one_that_the_link_refused(tmp_path: Path) -> None:
    folder = write_flight(tmp_path / "a", refused=range(1, 100, 2))
    seen = ObservationQueue(
        read_start(open_flight(folder), TINY, 0.4), make_sampler(), RecordingDecider()
    )
    # Before 0.5 s, every 0.05 s: an even tick, or the one before an odd one.
    np.testing.assert_allclose(seen.history()[0, :, 1], [0.03, 0.034, 0.04, 0.044], atol=1e-6)


def test_a_flight_without_states_frames_or_known_axes_is_refused(tmp_path: Path) -> None:
    blind = open_flight(write_flight(tmp_path / "a", frames=False))
    axes = replace(blind, meta=replace(blind.meta, contract=Contract(state_frame="enu_flu")))
    silent = open_flight(write_flight(tmp_path / "b", ticks=False))
    for flight, told in ((silent, "no state"), (blind, "no frames"), (axes, "has enu_flu")):
        with pytest.raises(UserError, match=told):
            read_start(flight, TINY, 0.0)


def test_a_start_within_a_gap_of_the_camera_is_refused(flight: Path) -> None:
    opened = open_flight(flight)
    after_ns = opened.frames["captured_ns"].to_numpy() - START_NS
    kept = np.flatnonzero((after_ns < 400 * NS_PER_MS) | (after_ns > 600 * NS_PER_MS))
    gap = replace(opened, frames=opened.frames.take(kept))
    for start_s, at in ((0.35, "0.45"), (0.5, "0.50")):
        with pytest.raises(UserError, match=f"no image within 0.05 s of {at} s"):
            read_start(gap, TINY, start_s)
    assert read_start(gap, TINY, 0.3).newest_ns < read_start(gap, TINY, 0.6).newest_ns


def test_a_start_from_a_state_that_is_too_old_is_refused_with_its_age(flight: Path) -> None:
    opened = open_flight(flight)
    slow = replace(opened, ticks=opened.ticks.take([*range(0, 100, 25)]))
    with pytest.raises(UserError, match=r"at 0.20 s its newest state is 200 ms old \(limit 100 ms"):
        read_start(slow, TINY, 0.2)


def test_a_policy_by_body_rates_is_refused() -> None:
    other = Contract(feature_dim=1, arrays="numpy", action="rates")
    with pytest.raises(UserError, match="flies by rates; flights are imagined from sticks"):
        PolicyDecider(noise_runner(other), make_sampler(), SteppedClock())


def test_a_scripted_policy_lives_in_imagined_time() -> None:
    start, sampler, times = make_start(), make_sampler(), []
    clock = SteppedClock(start.newest_ns)

    def act(*_: object) -> FloatArray:
        times.append(clock.now_ns() - start.newest_ns)
        return np.zeros((1, 16, 4), np.float32)

    decider = PolicyDecider(replace(noise_runner(), act=act), sampler, clock)
    for _ in rollout(sampler, decider, start, make_plan(exe_steps=2)):
        pass
    step_ns = round(TINY.frame_dt_s * NS_PER_S)
    assert times == [0, 2 * step_ns, 4 * step_ns]


def test_no_action_is_committed_where_deciding_takes_no_time() -> None:
    contract, histories = Contract(feature_dim=1, arrays="numpy", prefix_len=3), []

    def act(feature: FloatArray, state: FloatArray, history: FloatArray) -> FloatArray:
        histories.append(history)
        return np.zeros((1, 16, 4), np.float32)

    sampler, runner = make_sampler(), replace(noise_runner(contract), act=act)
    decider = PolicyDecider(runner, sampler, SteppedClock(START_NS))
    list(rollout(sampler, decider, make_start(), make_plan()))
    for history in histories:
        assert (history.shape, history.dtype) == ((1, *contract.history_shape), np.float32)
        assert np.isnan(history[0, :, 0]).tolist() == [False] * 4 + [True] * 3


@pytest.mark.parametrize(
    ("term", "value"),
    [("state_frame", "enu_flu"), ("full_lean_deg", 45.0), ("modes", ("LOITER",))],
)
def test_states_and_sticks_of_another_meaning_are_refused(
    flight: Path, term: str, value: Any
) -> None:
    other = Contract(feature_dim=1, arrays="numpy", **{term: value})
    with pytest.raises(UserError, match=f"trained with {term} .*the policy .* has "):
        PolicyDecider(noise_runner(other), make_sampler(), SteppedClock())
    opened = open_flight(flight)
    with pytest.raises(UserError, match=f"trained with {term} .*--start .* has "):
        read_start(replace(opened, meta=replace(opened.meta, contract=other)), TINY, 0.0)
    one_mode = Contract(feature_dim=1, arrays="numpy", modes=("ALT_HOLD",))
    assert (
        PolicyDecider(noise_runner(one_mode), make_sampler(), SteppedClock()).contract is one_mode
    )


def test_an_action_is_the_mean_of_the_chunk_over_its_step() -> None:
    ramp = noise_runner()
    chunk = np.repeat(np.linspace(-0.8, 0.8, 16, dtype=np.float32)[None, :, None], 4, axis=2)

    def act(*_: object) -> FloatArray:
        return chunk

    sampler = make_sampler()
    decider = PolicyDecider(replace(ramp, act=act), sampler, SteppedClock())
    actions = decider.decide(ObservationQueue(make_start(), sampler, decider), 0)
    # rows of the chunk are 0.05 s apart, steps 0.1 s: their mean is the row between; then held
    np.testing.assert_allclose(actions[:7, 0], chunk[0, 1:15:2, 0], atol=1e-6)
    np.testing.assert_allclose(actions[8:], 0.8, atol=1e-6)


pytestmark = pytest.mark.usefixtures("in_process_writer")


class RecordingDecider:
    """A decider with a queue of two that keeps what it has seen."""

    images = 2
    contract = Contract()

    def __init__(self) -> None:
        self.seen: list[list[ImageArray]] = []
        self.histories: list[FloatArray] = []

    def decide(self, seen: ObservationQueue, seed: int) -> FloatArray:
        self.seen.append(list(seen.images))
        self.histories.append(seen.history())
        return np.full((16, 4), 0.1 * len(self.seen), np.float32)


@pytest.mark.parametrize("exe_steps", [1, 2, 7])
def test_the_queue_gets_the_last_executed_frames_each_its_own(exe_steps: int) -> None:
    model, decider, start = TinyWorld(), RecordingDecider(), make_start()
    plan = make_plan(exe_steps=exe_steps, iterations=4)
    segments = list(rollout(make_sampler(model), decider, start, plan))
    executed = [*start.images]
    for segment, seen in zip(segments, decider.seen, strict=True):
        np.testing.assert_array_equal(seen, executed[-2:])
        assert (seen[0] != seen[1]).any()
        executed += list(model.decode(segment.latents[:exe_steps]).numpy())


def test_the_history_is_in_seconds_before_and_after_the_start() -> None:
    decider = RecordingDecider()
    plan = make_plan(exe_steps=1)
    list(rollout(make_sampler(), decider, make_start(), plan))
    throttle = [history[0, :, 0].tolist() for history in decider.histories]
    # 0.05 s a slot, 0.1 s a step; before the start the flight's own stick was held
    np.testing.assert_allclose(throttle[0], [0.1, 0.1, 0.1, 0.1])
    np.testing.assert_allclose(throttle[1], [0.1, 0.1, 0.1, 0.1], rtol=1e-6)
    np.testing.assert_allclose(throttle[2], [0.1, 0.1, 0.2, 0.2], rtol=1e-6)
