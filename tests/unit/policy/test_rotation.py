import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from policy import rotation

ANGLE = st.floats(-3.0, 3.0)


def about(axis: int, angle: float) -> np.ndarray:
    q = np.zeros((1, 4))
    q[0, 0], q[0, 1 + axis] = np.cos(angle / 2), np.sin(angle / 2)
    return q


def test_a_quarter_turn_about_the_third_axis_takes_x_to_y() -> None:
    turned = rotation.rotate(rotation.about_z(np.array([np.pi / 2])), np.array([[1.0, 0.0, 0.5]]))
    np.testing.assert_allclose(turned, [[0.0, 1.0, 0.5]], atol=1e-12)


@given(ANGLE, ANGLE, st.integers(0, 2), st.integers(0, 2))
def test_a_product_rotates_as_its_factors_one_after_the_other(
    a: float, b: float, i: int, j: int
) -> None:
    first, second = about(i, a), about(j, b)
    vector = np.array([[0.3, -1.2, 0.7]])
    together = rotation.rotate(rotation.multiply(second, first), vector)
    np.testing.assert_allclose(
        together, rotation.rotate(second, rotation.rotate(first, vector)), atol=1e-12
    )


@given(ANGLE, st.integers(0, 2))
def test_rotation_vector_is_axis_times_angle(angle: float, axis: int) -> None:
    expected = np.zeros((1, 3))
    expected[0, axis] = angle
    for sign in (1.0, -1.0):
        made = rotation.rotation_vector(sign * about(axis, angle))
        np.testing.assert_allclose(made, expected, atol=1e-6)


def test_interpolation_takes_the_shorter_way() -> None:
    half = rotation.interpolate(about(2, 0.2), -about(2, 0.4), np.array([0.5]))
    assert rotation.rotation_vector(half)[0, 2] == pytest.approx(0.3, abs=1e-9)
