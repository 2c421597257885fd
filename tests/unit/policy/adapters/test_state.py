"""Numbers made of the contract's state, in numpy and torch."""

import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch

from policy.adapters.interface import BODY_STATE_NAMES, DERIVED_NAMES, Interface, read_interface
from policy.contract import STATE_NAMES, Contract
from policy.errors import ContractError
from policy.motion.rotation import multiply, rotate

REST = (0.1, 0.2, 0.3, 1.0, 2.0, -9.0)
EULER = (0.4, -0.3, 2.5)


def about(axis: int, angle_rad: float) -> tuple[float, ...]:
    vector = [0.0, 0.0, 0.0]
    vector[axis] = math.sin(angle_rad / 2)
    return math.cos(angle_rad / 2), *vector


def attitude(roll_rad: float, pitch_rad: float, yaw_rad: float) -> tuple[float, ...]:
    return multiply(multiply(about(2, yaw_rad), about(1, pitch_rad)), about(0, roll_rad))


def state(velocity: Sequence[float], quaternion: Sequence[float]) -> np.ndarray:
    return np.array([(*velocity, *quaternion, *REST)], np.float32)


def test_euler_angles_are_those_of_the_turns() -> None:
    interface = Interface(contract=Contract(), state_names=("yaw_rad", "roll_rad", "pitch_rad"))
    found = interface.to_state(state((0, 0, 0), attitude(*EULER)))
    np.testing.assert_allclose(found, [[EULER[2], EULER[0], EULER[1]]], atol=1e-6)
    assert found.dtype == np.float32


def test_body_velocity_and_vertical_are_rotated_into_the_body() -> None:
    q = attitude(*EULER)
    interface = Interface(contract=Contract(), state_names=BODY_STATE_NAMES)
    found = interface.to_state(state(rotate(q, (4.0, -1.0, 0.5)), q))
    np.testing.assert_allclose(found[0, :3], (4.0, -1.0, 0.5), atol=1e-5)
    np.testing.assert_allclose(rotate(q, tuple(found[0, 3:6])), (0, 0, 1), atol=1e-6)
    np.testing.assert_allclose(found[0, 6:], REST, atol=1e-6)


def test_torch_and_several_observations_give_the_same_as_numpy() -> None:
    names = ("ax_mps2", *DERIVED_NAMES, "qw")
    scale = tuple(0.5 + 0.1 * k for k in range(len(names)))
    interface = Interface(contract=Contract(), state_names=names, state_scale=scale)
    both = np.stack([state((1, 2, 3), attitude(*EULER)), state((3, 2, 1), attitude(0.1, 0.2, -3))])
    one_by_one = np.stack([interface.to_state(each) for each in both])
    np.testing.assert_allclose(interface.to_state(both), one_by_one, atol=1e-6)
    tensor = interface.to_state(torch.from_numpy(both))
    np.testing.assert_allclose(tensor.numpy(), one_by_one, atol=1e-6)
    assert tensor.dtype == torch.float32
    assert interface.state_dim == len(names)


def test_the_contracts_own_state_is_passed_on_as_it_is() -> None:
    values = state((1, 2, 3), attitude(*EULER))
    assert Interface(contract=Contract()).to_state(values) is values
    swapped = Interface(contract=Contract(), state_names=STATE_NAMES[::-1]).to_state(values)
    np.testing.assert_array_equal(swapped, values[:, ::-1])


def test_actions_are_in_the_policys_order_and_units_and_back() -> None:
    interface = Interface(
        contract=Contract(),
        action_names=("roll", "pitch", "yaw", "throttle"),
        action_scale=(1.0, 1.0, 1.0, 0.5),
        action_offset=(0.0, 0.0, 0.25, 0.0),
    )
    sticks = np.array([[[0.1, 0.2, 0.3, 0.4]]], np.float32)
    for given in (sticks, torch.from_numpy(sticks)):
        theirs = interface.from_actions(given)
        np.testing.assert_allclose(theirs, [[[0.4, 0.3, -0.05, 0.2]]], atol=1e-6)
        np.testing.assert_allclose(interface.to_actions(theirs), sticks, atol=1e-6)


def test_names_and_scales_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ContractError, match=r"\[state\] scale must be 2 numbers"):
        Interface(contract=Contract(), state_names=("qw", "yaw_rad"), state_scale=(1.0,))
    with pytest.raises(ContractError, match=r"\['yaw_deg'\] are unknown.*vx_mps.*yaw_rad"):
        Interface(contract=Contract(), state_names=("yaw_deg",))


@pytest.mark.parametrize(
    "entry",
    [
        *("[state]\nscale = '1234567890123'", "[action]\nscale = '1234'"),
        *("[action]\noffset = [true, 0, 0, 0]", "[action]\nscale = ['2', 1, 1, 1]"),
        *("[action]\nscale = [nan, 1, 1, 1]", "[action]\noffset = [inf, 0, 0, 0]"),
        *("[action]\nscale = [1e-300, 1, 1, 1]", "[action]\nscale = 2"),
        *("[state]\nkey = 5", "[images]\nfront = ['rgb']", "[task]\nprompt = ['fly']"),
    ],
)
def test_an_entry_of_another_type_is_refused_by_its_name(entry: str, tmp_path: Path) -> None:
    path = tmp_path / "contract.toml"
    path.write_text(entry)
    table, name = entry.replace("\n", " ").split()[:2]
    with pytest.raises(ContractError, match=rf"{re.escape(table)} {name} must be a (list|text)"):
        read_interface(path)


@pytest.mark.parametrize("text", ["", "\n# horizon = 8\n"])
def test_a_contract_file_that_says_nothing_is_refused(text: str, tmp_path: Path) -> None:
    """As a copy of none of its bytes: every term would be a default, and fly."""
    path = tmp_path / "contract.toml"
    path.write_text(text)
    with pytest.raises(ContractError, match="says nothing: draft it by mavbridge contract"):
        read_interface(path)
