import json
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavbridge.config.flight import Limits
from mavbridge.config.policy import Rates
from mavbridge.flight.settings import effective_freshness
from mavbridge.flight.state import observation_ages_ns
from policy.contract import Contract, history_ages_ns
from policy.errors import ContractError
from policy.preprocess import least_source_px


def test_an_older_header_gets_the_defaults_of_what_came_later() -> None:
    header = {"version": 4, "horizon": 8, "image_height": 96}
    contract = Contract.from_json(json.dumps(header))
    assert contract == Contract(horizon=8, image_height=96)
    assert contract.version == 6
    with pytest.raises(ContractError, match=r"\['speed'\]; there are"):
        Contract.from_json(json.dumps({**header, "speed": 3}))


def test_shapes_grow_by_cameras_observations_and_extras() -> None:
    one = Contract(feature_dim=64, image_height=48, image_width=96)
    assert (one.state_shape, one.feature_shape, one.image_shape) == ((13,), (64,), (3, 48, 96))
    eyes = replace(one, cameras=("front", "down"))
    assert (eyes.feature_shape, eyes.image_shape) == ((128,), (2, 3, 48, 96))
    past = replace(eyes, observation_steps=2, since_exposure=True, state_extras=("height", "goal"))
    assert past.state_shape == (2, 24)
    assert past.state_names[20:] == ("height_above_home_m", "goal_x_m", "goal_y_m", "goal_z_m")
    assert (past.feature_shape, past.image_shape) == ((2, 128), (2, 2, 3, 48, 96))
    assert replace(one, observation_steps=2).image_shape == (2, 3, 48, 96)
    depth = replace(eyes, image_channels="depth")
    assert (depth.image_shape, depth.picture_shape) == ((2, 1, 48, 96), (48, 96))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cameras": "front"}, "cameras must be a list"),
        ({"cameras": ["front", "front"]}, "one or more different names"),
        ({"cameras": [1]}, "malformed"),
        ({"camera_rates_hz": [30.0, 10.0]}, "a rate in"),
        ({"image_crop": [0.0, 0.0, 1.0]}, "top, left, bottom, right"),
        ({"image_fit": "squash"}, "'stretch' or 'crop' or 'pad'"),
        ({"image_channels": "depth", "image_mean_rgb": [0.0, 0.0, 0.0]}, "image_mean_rgb"),
        ({"state_extras": ["speed"]}, "goal, height, altitude"),
        ({"play_s": 0.9}, "at most the 0.8 s of a chunk"),
        ({"prefix_len": 16}, "prefix_len must be less than horizon 16"),
        ({"prefix_len": 4, "state_time": "execution"}, "0 if state_time is 'execution', got 4"),
        ({"version": 3}, "version 3 is not supported"),
        ({"horizon": 0}, "horizon must be an integer in"),
        ({"image_std_rgb": [0.2, 0.2, 0.0]}, "3 numbers in"),
        ({"image_mean_rgb": [123.7, 116.3, 103.5]}, r"in \[-10, 10\], for pixels in \[0, 1\]"),
        ({"since_exposure": 1}, "since_exposure must be true or false"),
        ({"action": "torque"}, "action must be .*'velocity', got 'torque'"),
        ({"action": "velocity", "modes": ["GUIDED_NOGPS"]}, "of GUIDED, OFFBOARD for"),
        ({"lean_dead_zone": 0.9}, r"lean_dead_zone must be in \[0, 0.9\)"),
        ({"modes": "ALT_HOLD"}, "modes must be a list"),
        ({"modes": ["ALT_HOLD", "GUIDED"]}, r"for action 'sticks', got .*'GUIDED'"),
        ({"max_state_age_s": 0}, r"max_state_age_s must be in \[0.001, 60\] seconds, got 0"),
        ({"max_tilt_deg": 181}, r"max_tilt_deg must be in \[0.001, 180\] degrees"),
    ],
)
def test_invalid_fields_are_refused(changes: dict[str, object], message: str) -> None:
    text = json.dumps({**json.loads(Contract().to_json()), **changes})
    with pytest.raises(ContractError, match=message):
        Contract.from_json(text)


EXTREMES = st.one_of(
    st.sampled_from(
        [
            *(0, 1, -1, True, False, None, "", "x", [], (), {}, 2**31, 2**63, 2**64, 10**400),
            *(0.0, -0.0, 5e-324, 1e-300, 1e-10, 1e-9, 1e-3, 0.9, 1e9, 1e300, 1.8e308),
            *(float("nan"), float("inf"), -float("inf"), -1e-10, 10**5000),
        ]
    ),
    st.floats(),
    st.integers(),
)


@given(
    name=st.sampled_from([each.name for each in fields(Contract) if each.init]),
    value=st.one_of(EXTREMES, st.lists(EXTREMES, max_size=4), st.lists(EXTREMES).map(tuple)),
    through_json=st.booleans(),
)
@settings(max_examples=1000, deadline=None)
def test_any_value_of_any_field_gives_a_contract_or_an_error(name, value, through_json):
    """One that is made can be written, read, and computed with."""
    try:
        if through_json:
            try:
                text = json.dumps({**json.loads(Contract().to_json()), name: value})
            except ValueError:  # 5,000 digits, which json does not write
                return
            contract = Contract.from_json(text)
        else:
            contract = Contract(**{name: value})
    except ContractError:
        return
    assert Contract.from_json(contract.to_json()) == contract
    ages_ns = history_ages_ns(contract.history_len, contract.history_dt_s)
    assert len(ages_ns) == contract.history_len
    assert ages_ns[-1] >= 1_000_000
    period_ns = round(contract.chunk_dt_s * 1e9)
    assert 1_000_000 <= period_ns <= 10**9
    mean, std = (np.float32(v) for v in (contract.image_mean_rgb, contract.image_std_rgb))
    with np.errstate(all="raise"):
        assert np.isfinite((np.float32(1.0) - mean) / std).all()
    assert max(least_source_px(contract)) <= 4_096_000
    assert observation_ages_ns(contract)[0] <= 16 * 10**9
    for is_dual in (False, True):
        loops = Rates().loops(is_dual=is_dual, play_s=contract.play_s)
        assert 0 < loops.action_hz <= 2001
        assert effective_freshness(contract, Limits()).state_ns >= 0
