"""What a decider observes, and for how long it is held."""

import weakref
from pathlib import Path

import numpy as np
import pytest

from helpers.rollouts import TinyWorld, make_plan, make_sampler, make_start, run
from mavbridge.commands.imagine.loop import ObservationQueue, rollout
from mavbridge.commands.imagine.output import QUEUED_SEGMENTS
from mavbridge.core.records import FloatArray, ImageArray, RolloutFrame
from policy.contract import Contract

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


def test_no_frame_is_held_for_longer_than_a_queue_is_long(tmp_path: Path) -> None:
    frames, seen, held = 4, list[weakref.ref[object]](), list[int]()

    def on_frame(frame: RolloutFrame, rgb: ImageArray | None) -> None:
        seen.extend((weakref.ref(rgb), weakref.ref(frame.state)))
        held.append(sum(one() is not None for one in seen))

    plan = make_plan(iterations=96, frames=frames, exe_steps=2)
    run(tmp_path / "a.mp4", plan, decider="toge", on_frame=on_frame)
    assert len(seen) == 2 * 96 * frames
    # A segment in hand, and what the loop observes.
    assert max(held) <= 2 * (frames + QUEUED_SEGMENTS * frames) + 2
