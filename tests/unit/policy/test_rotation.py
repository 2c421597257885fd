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


@given(ANGLE, ANGLE, st.integers(0, 2), st.integers(0, 2))
def test_a_product_rotates_as_its_factors_one_after_the_other(a, b, i, j):
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


def test_interpolation_takes_the_shorter_way_at_an_even_rate() -> None:
    made = rotation.slerp(about(2, 0.2), -about(2, 2.2), np.array([0.25]))
    assert rotation.rotation_vector(made)[0, 2] == pytest.approx(0.7, abs=1e-9)


@given(ANGLE, ANGLE, st.integers(0, 2), st.floats(0, 1))
def test_floats_and_arrays_give_the_same(a: float, b: float, axis: int, share: float) -> None:
    arrays = rotation.multiply(about(0, a), about(1, 0.3)), about(axis, b)
    w, x, y, z = arrays[0][0].tolist()
    p, (w, x, y, z) = (w, x, y, z), arrays[1][0].tolist()
    turned = rotation.slerp(p, (w, x, y, z), share)
    assert isinstance(turned, tuple)
    np.testing.assert_allclose([turned], rotation.slerp(*arrays, np.array([share])), atol=1e-12)
    np.testing.assert_allclose(
        [rotation.rotate(p, (w, x, y))], rotation.rotate(arrays[0], arrays[1][:, :3]), atol=1e-12
    )


def test_the_other_frame_describes_the_same_motion_in_other_axes() -> None:
    """East, north, up and front, left, up are NED and FRD with two axes swapped or reversed."""
    enu_of_ned, flu_of_frd = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]]), np.diag([1, -1, -1])
    random = np.random.default_rng(3)
    states = random.normal(size=(20, 13))
    states[:, 3:7] /= np.linalg.norm(states[:, 3:7], axis=1, keepdims=True)
    made = rotation.other_frame(states)
    np.testing.assert_allclose(made[:, :3], states[:, :3] @ enu_of_ned.T)
    np.testing.assert_allclose(made[:, 7:10], states[:, 7:10] @ flu_of_frd)
    np.testing.assert_allclose(made[:, 10:], states[:, 10:] @ flu_of_frd)
    in_body = random.normal(size=(20, 3))
    in_world = rotation.rotate(states[:, 3:7], in_body) @ enu_of_ned.T
    np.testing.assert_allclose(rotation.rotate(made[:, 3:7], in_body @ flu_of_frd), in_world)
    np.testing.assert_allclose(rotation.other_frame(made), states, atol=1e-12)
    row = tuple(states[0].tolist())
    assert rotation.other_frame(row) == pytest.approx(tuple(made[0]))
    assert rotation.other_frame(row[:7]) == pytest.approx(tuple(made[0, :7]))
