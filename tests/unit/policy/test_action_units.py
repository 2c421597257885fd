import numpy as np
import pytest

from policy.action_units import action_units
from policy.contract import ActionKind, Contract

CONTRACTS: dict[ActionKind, Contract] = {
    "rates": Contract(action="rates", hover_thrust=0.5),
    "attitude": Contract(action="attitude", hover_thrust=0.5),
    "velocity": Contract(action="velocity"),
}


def test_sticks_are_computed_as_they_are() -> None:
    units = action_units(Contract())
    sticks = np.array([[0.3, -1.0, 0.0, 1.0]], np.float32)
    assert units.is_identity
    assert units.to_network(sticks) is sticks


@pytest.mark.parametrize("kind", list(CONTRACTS))
def test_what_does_nothing_is_zero_and_what_is_flown_fits(kind: ActionKind) -> None:
    units = action_units(CONTRACTS[kind])
    assert not units.is_identity
    assert units.to_network(np.array(units.neutral, np.float32)).tolist() == [0.0] * 4
    assert units.neutral[0] == (0.0 if kind == "velocity" else 0.5)
    most = np.array(units.neutral) + np.array(units.scale)
    np.testing.assert_allclose(units.to_network(most.astype(np.float32)), 1.0, rtol=1e-6)


def test_the_gates_usual_bounds_of_body_rates_fit() -> None:
    units = action_units(Contract(action="rates"))
    bounds = np.array([0.86, np.radians(220.0), np.radians(220.0), np.radians(120.0)], np.float32)
    assert (units.to_network(bounds) <= 1.0).all()


@pytest.mark.parametrize("signal", [1.0, 0.3])
def test_both_ways_are_inverse_for_noisy_actions_too(signal: float) -> None:
    units = action_units(CONTRACTS["rates"])
    actions = np.array([[0.4, 1.0, -3.0, 0.5]], np.float32)
    there = units.to_network(actions, signal)
    np.testing.assert_allclose(units.from_network(there, signal), actions, atol=1e-6)
