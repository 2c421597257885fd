"""Images are encoded once, in an order that makes the most of little time."""

from pathlib import Path

import numpy as np
import torch

from policy.training.batches import (
    ENCODE_BATCH,
    FeatureStore,
    Job,
    both_ways,
    encode_rows,
    one_way_first,
)

FRAMES = 2 * ENCODE_BATCH + 10


def encoded(path: Path, jobs: list[Job], *, jobs_done: int) -> FeatureStore:
    """Outputs that tell their image; negative where it was mirrored."""
    asked = iter(range(1, len(jobs) + 1))

    def encode(frames: np.ndarray, is_mirrored: bool) -> torch.Tensor:
        sign = -1.0 if is_mirrored else 1.0
        return sign * (1.0 + torch.from_numpy(frames).float())[:, None].expand(-1, 2)

    return encode_rows(path, jobs, encode, dim=2, should_continue=lambda _: next(asked) < jobs_done)


def test_half_of_the_time_encodes_each_image_one_way(tmp_path: Path) -> None:
    frames = np.random.default_rng(0).permutation(FRAMES)
    jobs = one_way_first(frames, mirror=True)
    store = encoded(tmp_path / "half", jobs, jobs_done=len(jobs) // 2)
    assert store.frames.tolist() == list(range(FRAMES))
    assert not store.has_mirrored
    for wanted in (False, True):
        ways = store.ways(store.frames, np.full(FRAMES, wanted))
        assert set(ways) == {False, True}
        read = store.read(store.frames, ways)
        assert np.array_equal(read[:, 0], np.where(ways, -1.0, 1.0) * (1 + store.frames))


def test_with_time_for_all_both_ways_are_there(tmp_path: Path) -> None:
    frames = np.random.default_rng(0).permutation(FRAMES)
    for name, jobs in (
        ("one", one_way_first(frames, mirror=True)),
        ("both", both_ways(frames, mirror=True)),
    ):
        store = encoded(tmp_path / name, jobs, jobs_done=len(jobs) + 1)
        assert store.has_mirrored
        for wanted in (False, True):
            assert set(store.ways(store.frames, np.full(FRAMES, wanted))) == {wanted}
