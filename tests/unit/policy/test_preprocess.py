from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers.factories import about_z
from policy.contract import QUATERNION, VELOCITY, Contract
from policy.errors import PolicyError
from policy.motion import rotation
from policy.preprocess import egocentric_columns, image_to_input

CONTRACT = Contract(image_height=32, image_width=48)


def test_normalises_each_channel_by_the_contract_and_averages_when_shrinking() -> None:
    rgb = np.zeros((64, 96, 3), np.uint8)
    rgb[::2] = (254, 0, 102)
    planes = image_to_input(rgb, CONTRACT)
    assert (planes.shape, planes.dtype) == ((1, 3, 32, 48), np.float32)
    expected = [(127 / 255 - 0.485) / 0.229, (0.0 - 0.456) / 0.224, (51 / 255 - 0.406) / 0.225]
    for channel, value in enumerate(expected):
        np.testing.assert_allclose(planes[0, channel], value, rtol=1e-4)


RED, GREEN, BLUE, WHITE = (255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255)
BLACK = (0, 0, 0)


def quarters(height: int, width: int) -> np.ndarray:
    """Red | green over blue | white: no two corners are alike."""
    image = np.empty((height, width, 3), np.uint8)
    image[: height // 2, : width // 2], image[: height // 2, width // 2 :] = RED, GREEN
    image[height // 2 :, : width // 2], image[height // 2 :, width // 2 :] = BLUE, WHITE
    return image


def plain(**settings: object) -> Contract:
    """A contract that leaves the values of an image as they are: 0 to 255."""
    one = 1 / 255
    return Contract(
        image_height=32,
        image_width=32,
        image_mean_rgb=(0, 0, 0),
        image_std_rgb=(one, one, one),
        **settings,  # type: ignore[arg-type]
    )


def pixels(rgb: np.ndarray, contract: Contract) -> np.ndarray:
    """[H, W, 3] as the policy sees it."""
    return image_to_input(rgb, contract)[0].transpose(1, 2, 0).round().astype(int)


def corners(seen: np.ndarray) -> list[tuple[int, ...]]:
    return [tuple(seen[row, column].tolist()) for row in (0, -1) for column in (0, -1)]


@pytest.mark.parametrize("size", [(32, 32), (48, 96), (20, 200)])
def test_a_stretched_picture_keeps_its_four_corners(size: tuple[int, int]) -> None:
    seen = pixels(quarters(*size), plain())
    assert corners(seen) == [RED, GREEN, BLUE, WHITE]
    for row, column in ((14, 14), (14, 17), (17, 14), (17, 17)):  # the middle stays the middle
        assert tuple(seen[row, column]) == tuple(seen[row // 16 * 31, column // 16 * 31])


def test_bgr_swaps_red_and_blue_and_their_normalisation() -> None:
    rgb = np.full((8, 8, 3), (255, 0, 51), np.uint8)
    usual, swapped = (
        image_to_input(rgb, Contract(image_height=16, image_width=16, image_channels=order))
        for order in ("rgb", "bgr")
    )
    np.testing.assert_array_equal(swapped, usual[:, ::-1])


def test_the_part_of_the_image_is_cut_out_before_it_is_resized() -> None:
    top_right = plain(image_crop=(0.0, 0.5, 0.5, 1.0))
    assert (pixels(quarters(60, 100), top_right) == GREEN).all()
    lower_half = pixels(quarters(60, 100), plain(image_crop=(0.5, 0.0, 1.0, 1.0)))
    assert corners(lower_half) == [BLUE, WHITE, BLUE, WHITE]
    assert (pixels(quarters(60, 100), plain(image_crop=(0.99, 0.0, 0.991, 0.001))) == BLUE).all()


@pytest.mark.parametrize("size", [(40, 80), (80, 40)])
def test_crop_cuts_the_longer_sides_off_and_pad_adds_black_bars(size: tuple[int, int]) -> None:
    height, width = size
    image = np.full((*size, 3), RED, np.uint8)
    image[height // 2 - 20 : height // 2 + 20, width // 2 - 20 : width // 2 + 20] = quarters(40, 40)
    cropped = pixels(image, plain(image_fit="crop"))
    np.testing.assert_array_equal(cropped, pixels(quarters(40, 40), plain()))
    padded = pixels(quarters(*size), plain(image_fit="pad"))
    padded = padded if width > height else padded.transpose(1, 0, 2)[..., [0, 2, 1]]
    assert (padded[:8] == BLACK).all()
    assert (padded[24:] == BLACK).all()
    assert corners(padded[8:24]) == [RED, GREEN, BLUE, WHITE]


DEPTH = Contract(image_height=32, image_width=48, image_channels="depth")


def test_depth_is_metres_and_the_unknown_is_zero() -> None:
    depth = np.full((32, 48), 1500, np.uint16)
    depth[0, 0], depth[0, 1] = 0, 65535
    planes = image_to_input(depth, DEPTH)
    assert (planes.shape, planes.dtype) == ((1, 1, 32, 48), np.float32)
    assert planes[0, 0, 0, :3].tolist() == pytest.approx([0.0, 65.535, 1.5])
    fine = replace(DEPTH, depth_unit_m=0.0002)
    np.testing.assert_allclose(image_to_input(depth, fine), planes / 5, rtol=1e-6)


@pytest.mark.parametrize("fit", ["stretch", "crop", "pad"])
@pytest.mark.parametrize("size", [(480, 640), (31, 100)])
def test_depth_is_never_interpolated(size: tuple[int, int], fit: Any) -> None:
    depth = np.random.default_rng(0).choice(np.array([0, 1000, 9000], np.uint16), size)
    planes = image_to_input(depth, replace(DEPTH, image_fit=fit))
    assert planes.shape == (1, 1, 32, 48)
    assert set(np.unique(planes.round(3))) <= {np.float32(0), np.float32(1), np.float32(9)}


@pytest.mark.parametrize(
    ("image", "contract"),
    [
        (np.zeros((32, 48), np.uint16), CONTRACT),
        (np.zeros((32, 48, 3), np.float32), CONTRACT),
        (np.zeros((0, 48, 3), np.uint8), CONTRACT),
        (np.zeros((32, 48, 3), np.uint8), DEPTH),
        (np.zeros((32, 48), np.float32), DEPTH),
    ],
)
def test_an_image_of_the_other_kind_is_refused(image: Any, contract: Contract) -> None:
    with pytest.raises(PolicyError, match=rf"{image.dtype} \[{image.shape[0]}, "):
        image_to_input(image, contract)


angle = st.floats(-3.1, 3.1)
number = st.floats(-20, 20)


def state(q: np.ndarray, velocity: tuple[float, float, float]) -> np.ndarray:
    return np.array([[*velocity, *q, 1.0, 2.0, 3.0, 4.0, 5.0, -9.0]], np.float32)


def unit(parts: tuple[float, float, float, float]) -> np.ndarray:
    return np.array(parts) / np.linalg.norm(parts)


attitudes = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1).map(unit)


@given(attitudes, st.tuples(number, number, number), angle)
def test_the_egocentric_state_does_not_depend_on_the_heading(q, velocity, turn):
    here = state(q, velocity)
    there = here.copy()
    about = about_z(np.array([turn]))
    there[:, QUATERNION] = rotation.multiply(about, here[:, QUATERNION].astype(np.float64))
    there[:, VELOCITY] = rotation.rotate(about, here[:, VELOCITY].astype(np.float64))
    seen, turned = (egocentric_columns(each[0].tolist()) for each in (here, there))
    np.testing.assert_allclose(turned, seen, atol=1e-4)
