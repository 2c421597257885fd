"""Likeness of images and of lists, against values that are known."""

import math

import numpy as np
import pytest

from mavbridge.commands.evaluate_imagination.metrics import psnr_db, slope, spearman, ssim
from mavbridge.core.records import ImageArray


def flat(value: int) -> ImageArray:
    return np.full((32, 32, 3), value, np.uint8)


def noisy(spread: int) -> ImageArray:
    signs = np.random.default_rng(0).integers(0, 2, (32, 32, 3)) * 2 - 1
    return (128 + spread * signs).astype(np.uint8)


def test_psnr_of_known_noise() -> None:
    assert psnr_db(noisy(10), flat(128)) == pytest.approx(20 * math.log10(255 / 10), abs=1e-4)
    assert psnr_db(flat(7), flat(7)) == 99.0


def test_ssim_of_an_image_with_itself_is_1() -> None:
    assert ssim(noisy(40), noisy(40)) == pytest.approx(1.0, abs=1e-12)


def test_ssim_of_flat_images_is_their_luminance_term() -> None:
    c1 = (0.01 * 255) ** 2
    expected = (2 * 100 * 150 + c1) / (100**2 + 150**2 + c1)
    assert ssim(flat(100), flat(150)) == pytest.approx(expected, abs=1e-9)


def test_ssim_falls_with_noise_and_is_negative_for_the_negative() -> None:
    true = noisy(40)
    worse = [ssim((true * a + 128 * (1 - a)).astype(np.uint8), true) for a in (0.8, 0.4, 0.1)]
    assert 1 > worse[0] > worse[1] > worse[2]
    assert ssim(255 - true, true) < -0.9


def test_ssim_needs_room_for_its_window() -> None:
    with pytest.raises(ValueError, match="11 pixels"):
        ssim(flat(0)[:8], flat(0)[:8])


def test_slope_and_spearman_of_a_bent_line() -> None:
    given = [-2.0, -1.0, 0.0, 1.0, 2.0]
    cubes = [0.5 * value**3 for value in given]
    assert spearman(given, cubes) == pytest.approx(1.0)
    assert spearman(given, [-c for c in cubes]) == pytest.approx(-1.0)
    assert slope(given, [3 * value + 7 for value in given]) == pytest.approx(3.0)
    assert slope(given, cubes) == pytest.approx(0.5 * (16 + 1 + 1 + 16) / 10)


def test_equal_values_share_a_rank() -> None:
    # Ranks 1.5 1.5 3 against 1 2 3: covariance 1.5, variances 1.5 and 2.
    assert spearman([0.0, 0.0, 1.0], [1.0, 2.0, 3.0]) == pytest.approx(1.5 / math.sqrt(1.5 * 2))


@pytest.mark.parametrize("given", [[], [1.0, 2.0], [0.0, 0.0, 0.0]])
def test_what_tells_nothing_has_no_slope(given: list[float]) -> None:
    found = [float(n) for n in range(len(given))]
    assert slope(given, found) is None
    assert spearman(given, found) is None


def test_a_source_that_never_moves_has_slope_0_and_no_ranks() -> None:
    assert slope([1.0, 2.0, 3.0], [5.0, 5.0, 5.0]) == 0.0
    assert spearman([1.0, 2.0, 3.0], [5.0, 5.0, 5.0]) is None
