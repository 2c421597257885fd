import pytest

from mavbridge.config.rates import Rates
from mavbridge.core.errors import UserError


def test_a_policy_may_be_as_slow_as_one_chunk_in_two_seconds() -> None:
    rates = Rates(rate=0.5, action_rate=0.5)
    assert rates.stick_rate == 100.0
    assert rates.loops(is_dual=False).action_hz == rates.loops(is_dual=True).action_hz == 0.5
    assert rates.loops(is_dual=True).state_hz == 50.0


@pytest.mark.parametrize(
    ("flag", "value", "message"),
    [
        ("rate", 0.4, "--rate must be between 0.5 and 500 Hz"),
        ("action_rate", 501.0, "--action-rate must be between 0.5 and 500 Hz"),
        ("stick_rate", 19.0, "--stick-rate must be between 20 and 400 Hz"),
        ("stick_rate", 401.0, "--stick-rate must be between 20 and 400 Hz"),
    ],
)
def test_a_rate_out_of_range_is_refused_by_its_flag(flag: str, value: float, message: str) -> None:
    with pytest.raises(UserError, match=message):
        Rates(**{flag: value})
