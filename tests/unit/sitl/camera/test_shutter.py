"""Rolling shutter and motion blur of a turning camera."""

from dataclasses import replace

import numpy as np
import pytest

from sitl.camera.fpv import FpvRenderer, Shutter
from sitl.course import make_course
from sitl.vehicle.conditions import NOMINAL
from sitl.vehicle.rotation import from_euler

SIZE_PX = 97
FOCAL_PX = (SIZE_PX - 1) / 2  # 90 degrees wide
POSITION = (1.0, 0.3, -2.2)


def shutter(exposure_s=0.0, readout_s=0.0):
    pixels = np.arange(SIZE_PX, dtype=np.float32)
    conditions = replace(NOMINAL, exposure_time_s=exposure_s, readout_time_s=readout_s)
    return Shutter(conditions, u_px=pixels, v_px=pixels[:, None], focal_px=FOCAL_PX)


def post():
    """A white line, one pixel wide, from top to bottom through the middle."""
    image = np.zeros((SIZE_PX, SIZE_PX, 3), np.uint8)
    image[:, SIZE_PX // 2] = 255
    return image


def middles_px(image):
    """Mean column of the light in each row."""
    light = image[..., 0].astype(float)
    return light @ np.arange(SIZE_PX) / light.sum(axis=1)


def test_turning_right_leans_a_post_to_the_left_further_down():
    """The last row is exposed later, when the post is farther left; the middle one at the stamp."""
    rate_radps, readout_s = 2.0, 0.02
    seen = middles_px(shutter(readout_s=readout_s).expose(post(), np.array([0.0, rate_radps, 0.0])))
    middle = SIZE_PX // 2
    shift_px = FOCAL_PX * rate_radps * readout_s / 2
    assert seen[middle] == pytest.approx(middle, abs=0.05)
    assert seen[0] == pytest.approx(middle + shift_px, abs=0.1)
    assert seen[-1] == pytest.approx(middle - shift_px, abs=0.1)


def test_an_exposure_smears_evenly_over_the_angle_that_it_turns():
    """The variance of an even spread is a twelfth of its squared width."""
    rate_radps, exposure_s = 3.0, 0.06
    seen = shutter(exposure_s).expose(post(), np.array([0.0, rate_radps, 0.0]))
    light = seen[SIZE_PX // 2, :, 0].astype(float)
    at_px = np.arange(SIZE_PX) - SIZE_PX // 2
    width_px = FOCAL_PX * rate_radps * exposure_s
    assert light.sum() == pytest.approx(255, rel=0.05)  # no light is lost
    assert light @ at_px / light.sum() == pytest.approx(0.0, abs=0.05)
    assert light @ at_px**2 / light.sum() == pytest.approx(width_px**2 / 12, rel=0.1)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_each_row_is_the_view_at_its_time(axis):
    """Against renderings at the time of every row."""
    size_px, readout_s, rate = 96, 0.05, [0.0, 0.0, 0.0]
    rate[axis] = 3.0
    rolling = replace(NOMINAL, readout_time_s=readout_s, camera_tilt_rad=0.0)
    course, level = make_course(7), from_euler(0, 0, 0)
    still = FpvRenderer(course, size_px, size_px, replace(rolling, readout_time_s=0.0))
    wanted = np.empty((size_px, size_px, 3))
    for row in range(size_px):
        at_s = (row / (size_px - 1) - 0.5) * readout_s
        wanted[row] = still.render(POSITION, from_euler(*(at_s * one for one in rate)))[row]
    seen = FpvRenderer(course, size_px, size_px, rolling).render(POSITION, level, tuple(rate))
    inside = slice(8, -8)
    error, unmoved = (
        np.abs(image.astype(float) - wanted)[inside, inside].mean()
        for image in (seen, still.render(POSITION, level))
    )
    assert error < 0.6 * unmoved
