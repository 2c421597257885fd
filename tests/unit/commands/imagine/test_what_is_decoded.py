"""No frame is decoded that nobody asked for, and none twice."""

import gc
import threading
import weakref
from pathlib import Path

import numpy as np
import pytest
import torch

from helpers.rollouts import TinyWorld, make_plan, make_sampler, make_start, run
from mavbridge.commands.imagine.loop import ObservationQueue, rollout
from mavbridge.commands.imagine.output import QUEUED_SEGMENTS
from mavbridge.core.records import FloatArray, ImageArray, RolloutFrame
from policy.contract import Contract

THREAD = "mavbridge-rollout-decode"
pytestmark = pytest.mark.usefixtures("in_process_writer")


@pytest.mark.parametrize(
    ("decider", "exe_steps", "decode_video", "in_loop"),
    [
        ("world-model", 1, True, 0),
        ("world-model", 16, True, 0),
        ("world-model", 16, False, 0),
        ("toge", 1, True, 1),
        ("toge", 16, True, 1),
        ("toge", 16, False, 1),
        ("world-model from pixels", 1, True, 1),
        ("world-model from pixels", 5, True, 2),
        ("world-model from pixels", 5, False, 2),
    ],
)
def test_exactly_the_frames_that_are_needed(
    tmp_path: Path, decider: str, exe_steps: int, decode_video: bool, in_loop: int
) -> None:
    """``in_loop``: min(exe_steps, queue length) for each observation; nobody observes the last."""
    plan = make_plan(exe_steps=exe_steps)
    done = run(tmp_path / "a.mp4", plan, decider=decider, decode_video=decode_video)
    by_thread = {True: 0, False: 0}
    for name, count in done.model.decoded:
        by_thread[name == THREAD] += count
    needed = in_loop * (plan.iterations - 1)
    assert by_thread[False] == done.sampler.frames_decoded == needed
    beside = plan.iterations * plan.frames - needed if decode_video else 0
    assert by_thread[True] == done.output.frames_decoded == beside
    assert (tmp_path / "a.mp4").exists() == decode_video


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


class Watch:
    """What is still held at two iterations, of all that has been seen until then."""

    def __init__(self, *iterations: int, frames: int) -> None:
        self._at = {k * frames: k for k in iterations}
        self._seen: list[weakref.ref[object]] = []
        self.images_and_states: dict[int, int] = {}
        self.tensors: dict[int, int] = {}
        self.threads: dict[int, int] = {}

    def __call__(self, frame: RolloutFrame, rgb: ImageArray | None) -> None:
        self._seen += [weakref.ref(rgb), weakref.ref(frame.state)]
        if (iteration := self._at.get(frame.number)) is not None:
            gc.collect()
            self.images_and_states[iteration] = sum(one() is not None for one in self._seen)
            self.tensors[iteration] = sum(
                issubclass(type(one), torch.Tensor) for one in gc.get_objects()
            )
            self.threads[iteration] = threading.active_count()


@pytest.mark.parametrize("is_kept", [False, True])
def test_nothing_grows_with_the_iterations_unless_frames_are_kept(
    tmp_path: Path, is_kept: bool
) -> None:
    frames = 4
    watch = Watch(24, 95, frames=frames)
    kept: list[object] = []

    def on_frame(frame: RolloutFrame, rgb: ImageArray | None) -> None:
        if is_kept:  # else this test could not fail
            kept.append((frame, rgb))
        watch(frame, rgb)

    plan = make_plan(iterations=96, frames=frames, exe_steps=2)
    run(tmp_path / "a.mp4", plan, decider="toge", on_frame=on_frame)
    held = watch.images_and_states
    if is_kept:
        assert held[95] - held[24] > 71 * frames
        return
    # a segment in hand, and what the loop observes
    assert max(held.values()) <= 2 * (frames + QUEUED_SEGMENTS * frames) + 2
    assert watch.tensors[95] - watch.tensors[24] < 50
    assert watch.threads[95] == watch.threads[24]
