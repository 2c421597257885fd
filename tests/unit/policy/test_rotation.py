import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from policy.motion import rotation

ANGLE = st.floats(-3.0, 3.0)


def about(axis: int, angle: float) -> np.ndarray:
    q = np.zeros((1, 4))
    q[0, 0], q[0, 1 + axis] = np.cos(angle / 2), np.sin(angle / 2)
    return q


@given(ANGLE, st.integers(0, 2))
def test_rotation_vector_is_axis_times_angle(angle: float, axis: int) -> None:
    expected = np.zeros((1, 3))
    expected[0, axis] = angle
    for sign in (1.0, -1.0):
        made = rotation.rotation_vector(sign * about(axis, angle))
        np.testing.assert_allclose(made, expected, atol=1e-6)


def test_interpolation_takes_the_shorter_way_at_an_even_rate() -> None:
    made = rotation.slerp(about(2, 0.2), -about(2, 2.2), np.array([0.25]))
    assert rotation.rotation_vector(made)[0, 2] == pytest.approx(0.7, abs=1e-9)
