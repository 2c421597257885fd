"""Rolling shutter and motion blur of a turning camera, and drops on its lens."""

from dataclasses import replace

import numpy as np
import pytest

from sitl.camera.fpv import FpvRenderer, LensDirt, Shutter
from sitl.course import make_course
from sitl.vehicle.conditions import NOMINAL, Conditions
from sitl.vehicle.rotation import from_euler

SIZE_PX = 97
FOCAL_PX = (SIZE_PX - 1) / 2  # 90 degrees wide
POSITION = (1.0, 0.3, -2.2)


def test_an_exposure_smears_evenly_over_the_angle_that_it_turns():
    """The variance of an even spread is a twelfth of its squared width."""
    rate_radps, exposure_s = 3.0, 0.06
    pixels = np.arange(SIZE_PX, dtype=np.float32)
    conditions = replace(NOMINAL, exposure_time_s=exposure_s)
    shutter = Shutter(conditions, u_px=pixels, v_px=pixels[:, None], focal_px=FOCAL_PX)
    post = np.zeros((SIZE_PX, SIZE_PX, 3), np.uint8)
    post[:, SIZE_PX // 2] = 255
    seen = shutter.expose(post, np.array([0.0, rate_radps, 0.0]))
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


def test_drops_blur_the_view_where_they_are_and_nowhere_else():
    """Of noise, since blur takes its contrast."""
    view = np.random.default_rng(1).integers(0, 256, (90, 120, 3), dtype=np.uint8)
    lens = LensDirt(Conditions(lens_drops=8.0, seed=3), 120, 90)
    changed = np.abs(lens.cover(view).astype(int) - view).max(axis=2) > 1
    assert 0.02 < changed.mean() < 0.5
    other = view[::-1].copy()
    again = np.abs(lens.cover(other).astype(int) - other).max(axis=2) > 1
    assert (again == changed).mean() > 0.97
