"""Measured durations against a contract; the measuring itself is in unit/policy."""

import re
from dataclasses import replace

import pytest

from mavbridge.config.flight import FlyConfig, LinkConfig
from mavbridge.config.policy import Rates
from mavbridge.core.errors import PolicyError
from mavbridge.flight.plan import plan_flight
from mavbridge.flight.speed import require_speed
from policy.contract import Contract
from policy.loading.request import SolveTimes

CONTRACT = Contract(feature_dim=1, arrays="numpy", horizon=100)


def notes_of(
    encode_ms: float,
    act_ms: float | None,
    *,
    hz: float | None = None,
    is_dual: bool = True,
    contract: Contract = CONTRACT,
) -> str:
    """What the user is told where a policy takes so long; its horizon is 5 s."""
    times = None
    if act_ms is not None:
        times = SolveTimes(encode_s=encode_ms / 1e3, act_s=act_ms / 1e3)
    config = FlyConfig(link=LinkConfig(connect="memory"), rates=Rates(rate=hz, action_rate=hz))
    plan = plan_flight(config, contract, is_dual=is_dual)
    return "; ".join(require_speed(plan, "test", times))


def playing(play_s: float) -> Contract:
    return replace(CONTRACT, play_s=play_s)


@pytest.mark.parametrize(
    ("encode_ms", "act_ms", "hz", "play_s", "told"),
    [
        (
            0,
            900,
            None,
            0,
            "a chunk takes 900 ms here.* attitude is up to 1.8 s old, beyond the 100",
        ),
        (300, 4, None, 0, "an image 300 ms.* the image is up to 614 ms old, beyond the 300 ms"),
        (0, 900, None, 0, "Use fewer --num-diffusion-steps"),
        (0, 20, 5, 0, "attitude is up to 220 ms old.* Use a higher rates.action"),
        (0, 900, 0.5, 0.8, "attitude is up to 2.9 s old, beyond the 900 ms"),
        (500, 20, 1, 2, "when a chunk is begun, the image is up to 1 s old, beyond the 300 ms"),
    ],
)
def test_one_that_clearly_cannot_keep_its_limits_is_refused_with_the_figures(
    encode_ms: float, act_ms: float, hz: float | None, play_s: float, told: str
) -> None:
    with pytest.raises(PolicyError, match=told):
        notes_of(encode_ms, act_ms, hz=hz, contract=playing(play_s))


@pytest.mark.parametrize("act_ms", [0.01, None])
@pytest.mark.parametrize(
    ("horizon", "dt_s", "hz", "least"),
    [(1, 0.02, None, 50), (1, 0.02, 30, 50), (2, 0.0125, 20, 40)],
)
def test_a_horizon_shorter_than_the_time_between_solves_is_refused_as_that(
    act_ms: float | None, horizon: int, dt_s: float, hz: float | None, least: int
) -> None:
    contract = replace(CONTRACT, horizon=horizon, chunk_dt_s=dt_s)
    with pytest.raises(PolicyError, match=f"solves .* rates.single {least} or more") as told:
        notes_of(0, act_ms, hz=hz, is_dual=False, contract=contract)
    assert "slow" not in str(told.value)
    assert f"{horizon} x {dt_s * 1e3:.0f}" in str(told.value)


@pytest.mark.parametrize(
    ("dt_s", "hz"),
    [(0.05, 20), (0.0333, 30), (0.033333, None), (0.02, 50), (0.01, 100), (1.0, None)],
)
def test_a_policy_of_one_step_needs_no_words_where_its_step_covers_the_time_between_solves(
    dt_s: float, hz: float | None
) -> None:
    contract = replace(CONTRACT, horizon=1, chunk_dt_s=dt_s)
    assert notes_of(0, 0.1, hz=hz, is_dual=False, contract=contract) == ""


@pytest.mark.parametrize(
    ("encode_ms", "act_ms", "play_s", "told"),
    [
        pytest.param(7, 4, 0, "", id="fast enough"),
        pytest.param(0, None, 0, "", id="not measured"),
        pytest.param(0, 400, 1.0, "2 chunks a second, .* plays each one for 1 s", id="plays long"),
        # Hardly missed is a warning, for a measurement may be wrong.
        pytest.param(0, 60, 0, "up to 120 ms old, .* will coast", id="limit hardly missed"),
        pytest.param(0, 32, 0, "100 chunks a second wanted, .* reaches about 31", id="chunk rate"),
        pytest.param(50, 4, 0, "30 images a second wanted, .* reaches about 20", id="image rate"),
    ],
)
def test_a_policy_that_may_fly_is_told_with_what_it_will_miss(
    encode_ms: float, act_ms: float | None, play_s: float, told: str
) -> None:
    notes = notes_of(encode_ms, act_ms, contract=playing(play_s))
    assert re.search(told, notes) if told else notes == ""
    assert not play_s or "warning" not in notes


@pytest.mark.parametrize(
    ("is_dual", "rates", "told"),
    [
        (
            True,
            Rates(rate=2),
            "warning: rates.single=2 applies to a single rate: add --single-rate",
        ),
        (
            False,
            Rates(action_rate=50),
            "warning: rates.action=50 applies to two rates: use rates.single",
        ),
        (True, Rates(rate=30, action_rate=50), None),
    ],
)
def test_a_rate_of_the_other_mode_is_not_ignored_in_silence(
    is_dual: bool, rates: Rates, told: str | None
) -> None:
    plan = plan_flight(FlyConfig(rates=rates), CONTRACT, is_dual=is_dual)
    assert require_speed(plan, "test", None) == (() if told is None else (told,))
