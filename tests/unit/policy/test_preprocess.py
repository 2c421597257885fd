import numpy as np
import pytest

from policy.contract import Contract
from policy.errors import PolicyError
from policy.preprocess import image_to_input

CONTRACT = Contract(image_height=32, image_width=48)


def test_normalises_each_channel_by_the_contract() -> None:
    rgb = np.empty((32, 48, 3), np.uint8)
    rgb[:] = (255, 0, 51)
    planes = image_to_input(rgb, CONTRACT)
    assert planes.shape == (1, 3, 32, 48)
    assert planes.dtype == np.float32
    expected = [(1.0 - 0.485) / 0.229, (0.0 - 0.456) / 0.224, (0.2 - 0.406) / 0.225]
    for channel, value in enumerate(expected):
        np.testing.assert_allclose(planes[0, channel], value, rtol=1e-5)


@pytest.mark.parametrize("size", [(64, 96), (480, 640), (16, 24), (31, 100)])
def test_any_size_keeps_brightness_and_sides(size: tuple[int, int]) -> None:
    rgb = np.zeros((*size, 3), np.uint8)
    rgb[:, size[1] // 2 :] = 200
    plain = Contract(
        image_height=32, image_width=48, image_mean_rgb=(0, 0, 0), image_std_rgb=(1, 1, 1)
    )
    planes = image_to_input(rgb, plain)
    assert planes.shape == (1, 3, 32, 48)
    np.testing.assert_allclose(planes[0, :, :, :20], 0.0, atol=1e-6)
    np.testing.assert_allclose(planes[0, :, :, -20:], 200 / 255, rtol=1e-5)


def test_shrinking_averages_instead_of_picking_pixels() -> None:
    rgb = np.zeros((64, 96, 3), np.uint8)
    rgb[::2] = 200
    plain = Contract(
        image_height=32, image_width=48, image_mean_rgb=(0, 0, 0), image_std_rgb=(1, 1, 1)
    )
    np.testing.assert_allclose(image_to_input(rgb, plain), 100 / 255, atol=1 / 255)


def test_takes_read_only_and_strided_views() -> None:
    rgb = np.arange(64 * 96 * 3, dtype=np.uint32).astype(np.uint8).reshape(64, 96, 3)
    rgb.flags.writeable = False
    mirrored = image_to_input(rgb[:, ::-1], CONTRACT)
    np.testing.assert_allclose(mirrored[..., ::-1], image_to_input(rgb, CONTRACT), atol=0.02)


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((32, 48, 3), np.float32),
        np.zeros((32, 48), np.uint8),
        np.zeros((32, 48, 4), np.uint8),
        np.zeros((3, 32, 48), np.uint8),
        np.zeros((0, 48, 3), np.uint8),
    ],
)
def test_refuses_what_is_no_rgb_image(image: np.ndarray) -> None:
    with pytest.raises(PolicyError, match=r"uint8 \[height, width, 3\]"):
        image_to_input(image, CONTRACT)
