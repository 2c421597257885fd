"""Images of a real sensor, of a simulator at rest, and of a camera that shows nothing."""

import numpy as np
import pytest

from mavbridge.camera.image_watch import TAKEOFF_NS, ImageWatch, is_blank
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.reasons import Code, because

PERIOD_NS = NS_PER_S // 20
RANDOM = np.random.default_rng(7)
SCENE = RANDOM.integers(30, 220, (48, 64, 3), dtype=np.uint8)


def noisy(level, sigma, shape=(224, 224, 3)):
    """A surface of one colour as a sensor records it."""
    return (level + sigma * RANDOM.standard_normal(shape)).round().clip(0, 255).astype(np.uint8)


def with_pixel(image, row, column):
    changed = image.copy()
    changed[row, column, 1] += 1
    return changed


def first_fault(watch, images, *, is_airborne=True, start=0):
    """Index of the first image that is refused, and why; images come at 20 Hz."""
    for index, image in enumerate(images, start):
        reason = watch.check(image, index * PERIOD_NS, is_airborne=is_airborne)
        if reason is not None:
            return index, reason
    return None


@pytest.fixture
def watch():
    return ImageWatch(max_frozen_s=0.5, max_black_s=0.5)


def test_the_same_pixels_beyond_the_limit_are_frozen(watch):
    copies = [SCENE.copy() for _ in range(40)]
    assert first_fault(watch, copies) == (11, because(Code.IMAGE_FROZEN, age_s=0.55))


@pytest.mark.parametrize("pixel", [(0, 0), (47, 63), (20, 31), (21, 32)])
def test_one_level_of_one_pixel_is_a_change(watch, pixel):
    images = [SCENE, with_pixel(SCENE, *pixel)] * 20
    assert first_fault(watch, images) is None


def test_take_off_has_time_to_move_the_image_and_no_more(watch):
    assert first_fault(watch, [SCENE] * 100, is_airborne=False) is None
    allowed = 99 + (TAKEOFF_NS + NS_PER_S // 2) // PERIOD_NS
    index, reason = first_fault(watch, [SCENE] * 100, start=100)
    assert index == allowed + 1
    assert reason == because(Code.IMAGE_FROZEN, age_s=index * PERIOD_NS / NS_PER_S)


@pytest.mark.parametrize(
    "image",
    [
        pytest.param(np.zeros((224, 224, 3), np.uint8), id="black"),
        pytest.param(np.full((224, 224, 3), 16, np.uint8), id="video black"),
        pytest.param(noisy(6, 4), id="covered sensor"),
        pytest.param(np.full((224, 224, 3), (0, 0, 255), np.uint8), id="blue of a lost signal"),
        pytest.param(np.full((224, 224, 3), 128, np.uint8), id="grey of a decoder"),
        pytest.param(np.full((1, 1, 3), 128, np.uint8), id="one pixel"),
    ],
)
def test_blank_images(watch, image):
    assert is_blank(image)
    index, reason = first_fault(watch, [image] * 40, is_airborne=False)
    assert (index, reason) == (
        11,
        because(Code.IMAGE_BLANK, what="black or of one colour", age_s=0.55),
    )


@pytest.mark.parametrize(
    "image",
    [
        pytest.param(SCENE, id="scene"),
        pytest.param(noisy(180, 2), id="overcast sky of a real sensor"),
        pytest.param(
            np.repeat(np.linspace(150, 190, 224, dtype=np.uint8), 224 * 3).reshape(224, 224, 3),
            id="noiseless gradient of a sky",
        ),
        pytest.param(
            np.where(np.arange(224)[:, None, None] < 10, 200, np.zeros((224, 224, 3))).astype(
                np.uint8
            ),
            id="a lit strip in the dark",
        ),
    ],
)
def test_images_that_show_something(watch, image):
    assert not is_blank(image)
    assert first_fault(watch, [image] * 40, is_airborne=False) is None


def test_a_limit_of_zero_turns_its_part_off():
    black = np.zeros_like(SCENE)
    _, frozen = first_fault(ImageWatch(max_frozen_s=0.5, max_black_s=0), [black] * 40)
    _, blank = first_fault(ImageWatch(max_frozen_s=0, max_black_s=0.5), [black] * 40)
    assert (frozen.code, blank.code) == (Code.IMAGE_FROZEN, Code.IMAGE_BLANK)
    assert first_fault(ImageWatch(max_frozen_s=0, max_black_s=0.5), [SCENE] * 40) is None
    assert first_fault(ImageWatch(max_frozen_s=0, max_black_s=0), [black] * 40) is None


@pytest.mark.parametrize(
    ("depth", "fault"),
    [
        (np.zeros((48, 64), np.uint16), True),
        (np.full((48, 64), 1500, np.uint16), False),  # a wall
        (np.full((48, 64), 3, np.uint16), False),  # in coarse units
    ],
)
def test_depth_that_is_nowhere_known_is_a_fault_and_a_wall_is_none(depth, fault):
    watch = ImageWatch(max_frozen_s=0.0, max_black_s=0.5)
    assert is_blank(depth) is fault
    found = first_fault(watch, [depth.copy() for _ in range(20)])
    assert (found is not None) is fault
    assert not fault or dict(found[1].data)["what"] == "without any depth"
