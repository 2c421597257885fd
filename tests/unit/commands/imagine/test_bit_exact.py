"""Decoding beside the loop gives the frames of the plain serial path, bit for bit.

No frame is decoded that nobody asked for, and none twice.
"""

import hashlib
from pathlib import Path

import numpy as np
import pytest

from helpers.recordings import count_frames
from helpers.rollouts import Finished, make_plan, make_sampler, read_rows, run, segments
from mavbridge.commands.imagine_rollout import DECIDE, SIMULATE, RolloutPlan

THREAD = "mavbridge-rollout-decode"

OBSERVED = {"world-model": 0, "world-model from pixels": 2, "toge": 1}
"""Images in the queue of each decider."""


def require_needed_decoded(
    done: Finished, plan: RolloutPlan, decider: str, *, decode_video: bool = True
) -> None:
    """What is observed is decoded in the loop, the rest beside it; nobody observes the last."""
    by_thread = {True: 0, False: 0}
    for name, count in done.model.decoded:
        by_thread[name.startswith(THREAD)] += count
    needed = min(plan.exe_steps, OBSERVED[decider]) * (plan.iterations - 1)
    assert by_thread[False] == needed
    assert by_thread[True] == (plan.iterations * plan.frames - needed if decode_video else 0)


@pytest.mark.parametrize("decider", OBSERVED)
@pytest.mark.parametrize("exe_steps", [1, 5, 16])
@pytest.mark.usefixtures("in_process_writer")
def test_frames_are_those_of_a_plain_loop_that_decodes_everything_at_the_end(
    tmp_path: Path, decider: str, exe_steps: int
) -> None:
    plan = make_plan(exe_steps=exe_steps, seed=exe_steps)
    ours = run(tmp_path / "ours.mp4", plan, decider=decider)
    require_needed_decoded(ours, plan, decider)
    sampler = make_sampler()
    plain = list(segments(sampler, plan, decider))
    pixels = np.concatenate([sampler.decode(segment.latents) for segment in plain])
    assert ours.sha256 == hashlib.sha256(pixels).hexdigest()
    rows = read_rows(tmp_path / "ours.mp4")
    states = np.concatenate([segment.states for segment in plain])
    actions = np.concatenate([segment.actions for segment in plain])
    assert rows["state"].to_pylist() == states.tolist()
    assert rows["action"].to_pylist() == actions.tolist()
    assert ours.output.frames == count_frames(tmp_path / "ours.mp4") == 48


@pytest.mark.parametrize("decider", OBSERVED)
def test_without_a_video_only_observed_frames_are_decoded(tmp_path: Path, decider: str) -> None:
    plan = make_plan(exe_steps=5)
    done = run(tmp_path / "a.mp4", plan, decider=decider, decode_video=False)
    require_needed_decoded(done, plan, decider, decode_video=False)
    assert not (tmp_path / "a.mp4").exists()


@pytest.mark.usefixtures("in_process_writer")
def test_more_iterations_only_add_to_a_rollout(tmp_path: Path) -> None:
    """A generator of its own for each iteration and stage: what follows changes nothing before."""
    short, long = tmp_path / "short.mp4", tmp_path / "long.mp4"
    run(short, make_plan(iterations=2, exe_steps=3))
    run(long, make_plan(iterations=4, exe_steps=3))
    assert read_rows(long).slice(0, 32).equals(read_rows(short))


def test_stages_and_iterations_share_no_noise() -> None:
    plans = [make_plan(seed=seed) for seed in (0, 1, 2**63 - 1)]
    stages = [(k, stage) for k in range(300) for stage in (DECIDE, SIMULATE)]
    seeds = [plan.stage_seed(*stage) for plan in plans for stage in stages]
    assert len(set(seeds)) == len(seeds)
    assert all(0 <= seed < 2**63 for seed in seeds)


@pytest.mark.usefixtures("in_process_writer")
def test_fewer_frames_are_the_first_of_each_segment(tmp_path: Path) -> None:
    run(tmp_path / "all.mp4", make_plan(exe_steps=4))
    run(tmp_path / "few.mp4", make_plan(exe_steps=4, frames=4))
    rows = read_rows(tmp_path / "all.mp4")
    executed = rows.filter(rows["executed"])
    few = read_rows(tmp_path / "few.mp4")
    assert few.equals(executed)
    assert count_frames(tmp_path / "few.mp4") == 12
    np.testing.assert_allclose(few["time_s"].to_pylist(), 0.1 * np.arange(1, 13))
