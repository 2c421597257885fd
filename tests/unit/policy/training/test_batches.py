"""Images are encoded once, and disturbed."""

import math

import numpy as np

from policy.training.batches import (
    SHARE,
    colour_matrix,
    disturb,
)


def test_images_are_disturbed_and_as_many_left_alone_as_the_shares_say() -> None:
    images = np.full((800, 48, 64, 3), 128, np.uint8)
    disturb(images, np.random.default_rng(0))
    same = (images == 128).all(axis=(1, 2, 3)).mean()
    assert abs(same - (1 - SHARE) ** 3) < 0.06  # new colours leave grey as it is
    means = images.mean(axis=(1, 2, 3))
    assert means.min() < 45
    assert means.max() > 200
    coloured = np.ptp(images, axis=3).max(axis=(1, 2)) > 0
    assert 0.15 < coloured.mean() < 0.35
    assert (images[~coloured].std(axis=(1, 2)).max(axis=1) > 20).any()


def test_colours_turn_about_grey() -> None:
    rgb = np.array([200.0, 40.0, 60.0])
    same, green, grey = (colour_matrix(*how) @ rgb for how in ((0, 1), (math.tau / 3, 1), (1, 0)))
    np.testing.assert_allclose(same, rgb)
    np.testing.assert_allclose(green, rgb[[2, 0, 1]])
    np.testing.assert_allclose(grey, 100.0)
