import json

import pytest

from policy.contract import Contract, ContractError


def test_round_trips_through_its_header_form() -> None:
    contract = Contract(state_frame="enu_flu", feature_dim=256, horizon=8, chunk_dt_s=0.02)
    assert Contract.from_json(contract.to_json()) == contract


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
