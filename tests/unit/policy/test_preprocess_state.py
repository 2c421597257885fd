import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from helpers.factories import about_z
from policy import rotation
from policy.contract import QUATERNION, VELOCITY, Contract
from policy.nets.encoders import StateEncoder
from policy.preprocess import egocentric

angle = st.floats(-3.1, 3.1)
number = st.floats(-20, 20)


def state(q: np.ndarray, velocity: tuple[float, float, float]) -> np.ndarray:
    return np.array([[*velocity, *q, 1.0, 2.0, 3.0, 4.0, 5.0, -9.0]], np.float32)


def unit(parts: tuple[float, float, float, float]) -> np.ndarray:
    return np.array(parts) / np.linalg.norm(parts)


attitudes = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1).map(unit)


@given(attitudes, st.tuples(number, number, number), angle)
def test_it_is_the_same_on_every_heading(q, velocity, turn):
    here = state(q, velocity)
    there = here.copy()
    about = about_z(np.array([turn]))
    there[:, QUATERNION] = rotation.multiply(about, here[:, QUATERNION].astype(np.float64))
    there[:, VELOCITY] = rotation.rotate(about, here[:, VELOCITY].astype(np.float64))
    contract = Contract()
    np.testing.assert_allclose(egocentric(there, contract), egocentric(here, contract), atol=2e-5)


@given(attitudes, st.tuples(number, number, number))
def test_velocity_and_vertical_are_those_of_the_body(q, velocity):
    seen = egocentric(state(q, velocity), Contract())[0]
    back = rotation.conjugate(q[None])
    expected = rotation.rotate(back, np.array([velocity]))[0] / 5
    np.testing.assert_allclose(seen[:3], expected, atol=1e-5)
    down = rotation.rotate(back, np.array([[0.0, 0.0, 1.0]]))[0]
    np.testing.assert_allclose(seen[3:6], down, atol=1e-6)


@pytest.mark.parametrize("since_exposure", [False, True])
def test_numpy_and_torch_see_the_same(since_exposure: bool) -> None:
    contract = Contract(since_exposure=since_exposure)
    random = np.random.default_rng(0)
    states = random.normal(size=(8, contract.state_dim)).astype(np.float32)
    states[:, QUATERNION] /= np.linalg.norm(states[:, QUATERNION], axis=1, keepdims=True)
    seen = StateEncoder(8, contract).normalise(torch.from_numpy(states)).numpy()
    np.testing.assert_allclose(egocentric(states, contract), seen, atol=1e-6)
    assert seen.shape == (8, contract.state_dim - 1)
