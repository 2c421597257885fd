import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sitl.camera import scenery
from sitl.camera.fpv import FpvRenderer
from sitl.course import Course, Gate, make_course
from sitl.vehicle.conditions import NOMINAL
from sitl.vehicle.rotation import IDENTITY, from_euler

TILT_UP_RAD = NOMINAL.camera_tilt_rad
SIZE_PX = 201
FOCAL_PX = SIZE_PX / 2
MIDDLE_PX = (SIZE_PX - 1) / 2
COURSE = Course(
    seed=0, gates=(Gate(center_ned_m=(10.0, 0.0, -2.0), yaw_rad=0.0, size_m=2.4, index=0),)
)
WHOLE_COURSE = make_course(7)
WHOLE_RENDERER = FpvRenderer(WHOLE_COURSE, 64, 48)
LEVEL_CAMERA = from_euler(0.0, -TILT_UP_RAD, 0.0)
"""Body pitch that makes the optical axis horizontal."""


def is_orange(image):
    """Hue of the first gate, in light or shadow, hazed or not."""
    red, green, blue = np.moveaxis(image.astype(int), -1, 0)
    return (red > green + 50) & (green > blue + 20)


@pytest.fixture(scope="module")
def renderer():
    return FpvRenderer(COURSE, SIZE_PX, SIZE_PX)


@pytest.mark.parametrize(
    ("position", "attitude", "centre_px"),
    [
        pytest.param((4.0, 0.0, -2.0), LEVEL_CAMERA, (0.0, 0.0), id="straight ahead"),
        pytest.param((4.0, -3.0, -2.0), LEVEL_CAMERA, (3 / 6, 0.0), id="eye left, gate right"),
        pytest.param((4.0, 0.0, -4.0), LEVEL_CAMERA, (0.0, 2 / 6), id="eye high, gate low"),
        pytest.param(
            (4.0, 0.0, -2.0), IDENTITY, (0.0, math.tan(TILT_UP_RAD)), id="level body, tilted camera"
        ),
        pytest.param(
            (4.0, 0.0, -2.0),
            from_euler(0.0, -TILT_UP_RAD, 0.3),
            (-math.tan(0.3), 0.0),
            id="nose right, gate left",
        ),
    ],
)
def test_projection_of_the_gate_centre(renderer, position, attitude, centre_px):
    """Offsets in units of the focal length, by hand; right and down positive."""
    rows, columns = np.nonzero(is_orange(renderer.render(position, attitude)))
    middle = ((columns.min() + columns.max()) / 2, (rows.min() + rows.max()) / 2)
    wanted = [MIDDLE_PX + FOCAL_PX * offset for offset in centre_px]
    assert middle == pytest.approx(wanted, abs=3.0)


def test_the_nearer_gate_hides_the_farther_one():
    """Eye at north 1: the left bar of the orange gate stands right behind that of the red one."""
    near_m, far_m = (north - scenery.DEPTH_M / 2 - 1.0 for north in (6.0, 14.0))
    bar_m = 1.2 + scenery.BAR_M / 2
    far_east_m = bar_m - bar_m * far_m / near_m
    places = [(14.0, far_east_m, -2.0), (6.0, 0.0, -2.0)]
    gates = [
        Gate(center_ned_m=center, yaw_rad=0.0, size_m=2.4, index=index)
        for index, center in enumerate(places)
    ]
    renderer = FpvRenderer(Course(seed=0, gates=tuple(gates)), SIZE_PX, SIZE_PX)
    image = renderer.render((1.0, 0.0, -2.0), LEVEL_CAMERA)
    column = round(MIDDLE_PX - FOCAL_PX * bar_m / near_m)
    red, green, _ = image[round(MIDDLE_PX), column].astype(int)
    assert red > 3 * green


def test_a_wall_that_reaches_behind_the_eye_is_cut_where_it_should_be(renderer):
    """In the opening, 0.3 m from its right wall, nose 0.5 rad right: the wall's far edge is at
    (x, z) = (0.3 cos - 0.12 sin, 0.3 sin + 0.12 cos), its near edge behind the near plane."""
    edge = (0.3 * math.cos(0.5) - 0.12 * math.sin(0.5)) / (
        0.3 * math.sin(0.5) + 0.12 * math.cos(0.5)
    )
    image = renderer.render((10.0, 0.9, -2.0), from_euler(0.0, -TILT_UP_RAD, 0.5))
    row = is_orange(image)[round(MIDDLE_PX)]
    assert np.flatnonzero(row)[0] == pytest.approx(MIDDLE_PX + FOCAL_PX * edge, abs=1.5)
    assert row[np.flatnonzero(row)[0] :].all()


@settings(max_examples=60, deadline=None)
@given(
    st.tuples(*[st.floats(-14.0, 14.0)] * 2, st.floats(-8.0, 1.0)),
    st.tuples(*[st.floats(-math.pi, math.pi)] * 3),
)
def test_any_pose_gives_a_picture(position, angles):
    center_ned_m = WHOLE_COURSE.gates[1].center_ned_m
    near_gate = tuple(p + c for p, c in zip(position, center_ned_m, strict=True))
    image = WHOLE_RENDERER.render(near_gate, from_euler(*angles))
    assert image.shape == (48, 64, 3)
    assert image.dtype == np.uint8
