"""Disturbed images: some left alone, all still images."""

import numpy as np

from policy.training.batches import SHARE, disturb


def grey(count: int) -> np.ndarray:
    return np.full((count, 48, 64, 3), 128, np.uint8)


def disturbed(count: int, seed: int = 0) -> np.ndarray:
    images = grey(count)
    disturb(images, np.random.default_rng(seed))
    return images


def test_as_many_are_left_alone_as_the_shares_say() -> None:
    same = (disturbed(800) == 128).all(axis=(1, 2, 3)).mean()
    assert abs(same - (1 - SHARE) ** 3) < 0.06


def test_there_are_darker_lighter_uneven_and_covered_ones() -> None:
    images = disturbed(400).astype(float)
    means = images.mean(axis=(1, 2, 3))
    assert means.min() < 45
    assert means.max() > 200
    coloured = np.ptp(images, axis=3).max(axis=(1, 2)) > 0
    assert 0.15 < coloured.mean() < 0.35
    grey_ones = images[~coloured]
    assert (grey_ones.std(axis=(1, 2)).max(axis=1) > 20).any()
