import json
from dataclasses import replace

import pytest

from policy.contract import (
    AGE,
    ROTATION,
    SINCE_EXPOSURE_NAMES,
    STATE_NAMES,
    VELOCITY_CHANGE,
    Contract,
)
from policy.errors import ContractError


def test_round_trips_through_its_header_form() -> None:
    contract = Contract(
        state_frame="enu_flu", feature_dim=256, horizon=8, chunk_dt_s=0.02, since_exposure=True
    )
    assert Contract.from_json(contract.to_json()) == contract


def test_a_header_that_does_not_speak_of_the_exposure_is_of_thirteen_numbers() -> None:
    header = json.loads(Contract().to_json())
    del header["since_exposure"]
    contract = Contract.from_json(json.dumps(header))
    assert contract == Contract()
    assert contract.state_dim == len(STATE_NAMES) == 13
    assert replace(contract, since_exposure=True).state_dim == 20


def test_the_appended_names_lie_where_their_slices_say() -> None:
    names = STATE_NAMES + SINCE_EXPOSURE_NAMES
    assert names[AGE] == ("age_s",)
    assert all(name.startswith("rotation_") for name in names[ROTATION])
    assert all(name.startswith("velocity_change_") for name in names[VELOCITY_CHANGE])
    assert VELOCITY_CHANGE.stop == len(names)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"version": 2}, "version 2 is not supported"),
        ({"state_frame": "nwu"}, "ned_frd"),
        ({"arrays": "jax"}, "numpy"),
        ({"horizon": 0}, "horizon must be an integer in"),
        ({"horizon": 1_000_000}, "horizon must be an integer in"),
        ({"image_height": 224.0}, "image_height must be an integer"),
        ({"chunk_dt_s": 0.0}, "chunk_dt_s"),
        ({"chunk_dt_s": "fast"}, "malformed contract"),
        ({"image_mean_rgb": [0.5, 0.5]}, "three numbers"),
        ({"image_mean_rgb": ["a", "b", "c"]}, "three numbers"),
        ({"image_std_rgb": [0.2, 0.2, 0.0]}, "positive"),
        ({"image_std_rgb": [0.2, 0.2, float("nan")]}, "finite"),
        ({"since_exposure": 1}, "since_exposure must be true or false"),
        ({"colour": "bgr"}, "unknown contract keys"),
    ],
)
def test_refuses_what_cannot_be_kept(changes: dict[str, object], message: str) -> None:
    text = json.dumps({**json.loads(Contract().to_json()), **changes})
    with pytest.raises(ContractError, match=message):
        Contract.from_json(text)


@pytest.mark.parametrize("text", ["", "[]", "{", "null"])
def test_refuses_what_is_no_json_object(text: str) -> None:
    with pytest.raises(ContractError):
        Contract.from_json(text)
