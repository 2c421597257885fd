"""Pooling keeps where things are."""

import pytest
import torch

from policy.nets.pooling import moments


def test_first_moment_is_the_average() -> None:
    features = torch.randn(2, 5, 4, 7)
    torch.testing.assert_close(moments(features)[:, 0], features.mean(dim=(2, 3)))


@pytest.mark.parametrize(("height", "width"), [(1, 1), (3, 3), (4, 7)])
def test_a_uniform_map_is_nowhere_in_particular(height: int, width: int) -> None:
    pooled = moments(torch.full((1, 2, height, width), 3.0))
    torch.testing.assert_close(pooled[:, 1:], torch.zeros(1, 2, 2))


def test_a_spot_is_where_it_is_at_every_size() -> None:
    for size in (4, 8):
        features = torch.zeros(1, 1, size, size)
        spot = slice(3 * size // 4, None), slice(0, size // 4)  # low, left
        features[0, 0][spot] = 1.0
        average, across, down = moments(features)[0, :, 0]
        assert float(across / average) == pytest.approx(-(3**0.5) * 0.75)
        assert float(down / average) == pytest.approx(3**0.5 * 0.75)
