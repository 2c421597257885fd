"""Images are encoded once, in an order that makes the most of little time."""

from pathlib import Path

import numpy as np
import torch

from policy.training.batches import (
    ENCODE_BATCH,
    SHARE,
    FeatureStore,
    Job,
    both_ways,
    disturb,
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
    frames = np.arange(FRAMES)
    for order in (one_way_first, both_ways):
        jobs = order(frames, mirror=True)
        store = encoded(tmp_path / "all", jobs, jobs_done=len(jobs) + 1)
        assert store.has_mirrored
        for wanted in (False, True):
            assert set(store.ways(store.frames, np.full(FRAMES, wanted))) == {wanted}


def test_images_are_disturbed_and_as_many_left_alone_as_the_shares_say() -> None:
    images = np.full((800, 48, 64, 3), 128, np.uint8)
    disturb(images, np.random.default_rng(0))
    same = (images == 128).all(axis=(1, 2, 3)).mean()
    assert abs(same - (1 - SHARE) ** 3) < 0.06
    means = images.mean(axis=(1, 2, 3))
    assert means.min() < 45
    assert means.max() > 200
    coloured = np.ptp(images, axis=3).max(axis=(1, 2)) > 0
    assert 0.15 < coloured.mean() < 0.35
    assert (images[~coloured].std(axis=(1, 2)).max(axis=1) > 20).any()
