import pytest

from benchmarks.compare import RATES_HZ, highest_rate

KEPT, NEARLY, FAR = 0.0, 0.01, 0.5


@pytest.mark.parametrize("limit_hz", [None, *RATES_HZ])
def test_finds_the_highest_rate_that_is_kept(limit_hz: float | None) -> None:
    def missed(rate_hz: float) -> float:
        return KEPT if limit_hz is not None and rate_hz <= limit_hz else FAR

    assert highest_rate(RATES_HZ, missed) == limit_hz


def test_a_single_stall_gets_a_second_chance() -> None:
    answers = iter([NEARLY, KEPT])
    assert highest_rate([100.0], lambda _: next(answers)) == 100.0


def test_a_rate_far_out_of_reach_is_flown_once() -> None:
    flown: list[float] = []

    def missed(rate_hz: float) -> float:
        flown.append(rate_hz)
        return FAR

    assert highest_rate([100.0], missed) is None
    assert flown == [100.0]


def test_no_rates_no_answer() -> None:
    assert highest_rate([], lambda _: KEPT) is None
