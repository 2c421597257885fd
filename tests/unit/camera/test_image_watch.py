"""Images of a real sensor, of a simulator at rest, and of a camera that shows nothing."""

import numpy as np
import pytest

from mavbridge.camera.image_watch import TAKEOFF_NS, ImageWatch, is_blank
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.reasons import Code, because

PERIOD_NS = NS_PER_S // 20
RANDOM = np.random.default_rng(7)
SCENE = RANDOM.integers(30, 220, (48, 64, 3), dtype=np.uint8)
BLACK = np.zeros_like(SCENE)
SKY = np.linspace(150, 190, 224, dtype=np.uint8)[:, None, None]
DARK_STRIP = np.where(np.arange(224) < 10, 200, 0).astype(np.uint8)[:, None, None]


def plain(colour, dtype=np.uint8, axes=(3,)):
    return np.full((224, 224, *axes), colour, dtype)


def noisy(level, sigma):
    """A surface of one colour as a sensor records it."""
    noise = sigma * RANDOM.standard_normal((224, 224, 3))
    return (level + noise).round().clip(0, 255).astype(np.uint8)


def depth(level):
    return plain(level, np.uint16, ())


def first_fault(images, *, is_airborne=True, start=0, watch=None, **limits):
    """Index of the first image that is refused, and why; images come at 20 Hz."""
    watch = watch or ImageWatch(**{"max_frozen_s": 0.5, "max_black_s": 0.5} | limits)
    for index, image in enumerate(images, start):
        reason = watch.check(image, index * PERIOD_NS, is_airborne=is_airborne)
        if reason is not None:
            return index, reason
    return None


def test_the_same_pixels_beyond_the_limit_are_frozen():
    copies = [SCENE.copy() for _ in range(40)]
    assert first_fault(copies) == (11, because(Code.IMAGE_FROZEN, age_s=0.55))


@pytest.mark.parametrize("pixel", [(0, 0), (47, 63), (20, 31), (21, 32)])
def test_one_level_of_one_pixel_is_a_change(pixel):
    changed = SCENE.copy()
    changed[pixel][1] += 1
    assert first_fault([SCENE, changed] * 20) is None


def test_take_off_has_time_to_move_the_image_and_no_more():
    watch = ImageWatch(max_frozen_s=0.5, max_black_s=0.5)
    assert first_fault([SCENE] * 100, watch=watch, is_airborne=False) is None
    allowed = 99 + (TAKEOFF_NS + NS_PER_S // 2) // PERIOD_NS
    index, reason = first_fault([SCENE] * 100, watch=watch, start=100)
    assert index == allowed + 1
    assert reason == because(Code.IMAGE_FROZEN, age_s=index * PERIOD_NS / NS_PER_S)


@pytest.mark.parametrize(
    ("image", "what"),
    [
        pytest.param(plain(0), "black or of one colour", id="black"),
        pytest.param(plain(16), "black or of one colour", id="video black"),
        pytest.param(noisy(6, 4), "black or of one colour", id="covered sensor"),
        pytest.param(plain((0, 0, 255)), "black or of one colour", id="blue of a lost signal"),
        pytest.param(plain(128), "black or of one colour", id="grey of a decoder"),
        pytest.param(plain(128)[:1, :1], "black or of one colour", id="one pixel"),
        pytest.param(depth(0), "without any depth", id="no depth"),
        pytest.param(SCENE, None, id="scene"),
        pytest.param(noisy(180, 2), None, id="overcast sky of a real sensor"),
        pytest.param(plain(0) + SKY, None, id="noiseless gradient of a sky"),
        pytest.param(plain(0) + DARK_STRIP, None, id="a lit strip in the dark"),
        pytest.param(depth(1500), None, id="a wall"),
        pytest.param(depth(3), None, id="a wall in coarse units"),
    ],
)
def test_images_that_show_something_and_images_that_do_not(image, what):
    assert is_blank(image) is (what is not None)
    fault = what and (11, because(Code.IMAGE_BLANK, what=what, age_s=0.55))
    assert first_fault([image] * 40, is_airborne=False) == fault


@pytest.mark.parametrize(
    ("image", "limits", "code"),
    [
        (BLACK, {"max_black_s": 0}, Code.IMAGE_FROZEN),
        (BLACK, {"max_frozen_s": 0}, Code.IMAGE_BLANK),
        (SCENE, {"max_frozen_s": 0}, None),
        (BLACK, {"max_frozen_s": 0, "max_black_s": 0}, None),
    ],
)
def test_a_limit_of_zero_turns_its_part_off(image, limits, code):
    fault = first_fault([image] * 40, **limits)
    assert (fault and fault[1].code) == code
