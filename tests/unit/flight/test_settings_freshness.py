import pytest

from mavbridge.config.flight import Limits
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.errors import UserError
from mavbridge.flight.settings import contract_with_ages, effective_freshness
from mavbridge.guard.chunks import FreshnessLimits
from policy.contract import Contract

CONTRACT = Contract(
    max_state_age_s=0.2,
    max_velocity_age_s=0.4,
    max_feature_age_s=2,
    max_chunk_age_s=1.5,
    max_stall_s=0.5,
)
STALL_MS = 500


def in_ms(
    state: int, velocity: int, feature: int, chunk: int, stall: int = STALL_MS
) -> FreshnessLimits:
    return FreshnessLimits(
        state_ns=state * NS_PER_MS,
        velocity_ns=velocity * NS_PER_MS,
        feature_ns=feature * NS_PER_MS,
        chunk_ns=chunk * NS_PER_MS,
        stall_ns=stall * NS_PER_MS,
    )


@pytest.mark.parametrize(
    ("contract", "limits", "expected"),
    [
        (CONTRACT, Limits(), in_ms(200, 400, 2000, 1500)),
        (Contract(), Limits(), in_ms(100, 250, 300, 300, 250)),
        (CONTRACT, Limits(max_attitude_age=0.05, max_chunk_age=1.5), in_ms(50, 400, 2000, 1500)),
        (
            CONTRACT,
            Limits(max_velocity_age=0.3, max_feature_age=0.25, max_stall=0.2),
            in_ms(200, 300, 250, 1500, 200),
        ),
    ],
)
def test_ages_are_the_contracts_and_flags_tighten_one_by_one(
    contract: Contract, limits: Limits, expected: FreshnessLimits
) -> None:
    assert effective_freshness(contract, limits) == expected


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        (
            Limits(max_attitude_age=0.25),
            "limits.attitude_age=0.25 is looser than the 0.2 s",
        ),
        (Limits(max_velocity_age=0.5), "limits.velocity_age=0.5 is looser than the 0.4 s"),
        (Limits(max_feature_age=5), "limits.feature_age=5 is looser than the 2 s"),
        (Limits(max_chunk_age=1.6), "limits.chunk_age=1.6 is looser than the 1.5 s"),
        (Limits(max_stall=0.6), "limits.stall=0.6 is looser than the 0.5 s"),
    ],
)
def test_a_flag_that_would_loosen_is_refused(limits: Limits, message: str) -> None:
    with pytest.raises(UserError, match=message):
        effective_freshness(CONTRACT, limits)
    allowed = effective_freshness(contract_with_ages(CONTRACT, limits), limits)
    assert allowed != effective_freshness(CONTRACT, Limits())


def test_a_measured_flight_may_have_tighter_ages_too() -> None:
    limits = Limits(max_attitude_age=0.02, max_velocity_age=1, max_feature_age=0.5, max_chunk_age=9)
    contract = contract_with_ages(CONTRACT, limits)
    assert effective_freshness(contract, Limits()) == in_ms(20, 1000, 500, 9000)
    assert contract_with_ages(CONTRACT, Limits()) == CONTRACT


@pytest.mark.parametrize("name", ["attitude", "velocity", "feature", "chunk"])
@pytest.mark.parametrize("age_s", [0.0, -1.0, 61.0, float("nan")])
def test_an_age_out_of_range_is_refused_by_its_flag(name: str, age_s: float) -> None:
    with pytest.raises(UserError, match=f"limits.{name}_age must be between 0.01 and 60 s"):
        Limits(**{f"max_{name}_age": age_s})
