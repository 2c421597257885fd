import pytest

from mavbridge.commands.evaluate import mean, rate


@pytest.mark.parametrize(
    ("successes", "count", "low", "high"),
    [  # Wilson's interval with z = 1.96, by hand
        (8, 10, 0.4902, 0.9433),
        (0, 10, 0.0, 0.2775),
        (10, 10, 0.7225, 1.0),
        (1, 1, 0.2065, 1.0),
        (50, 100, 0.4038, 0.5962),
    ],
)
def test_wilson(successes: int, count: int, low: float, high: float) -> None:
    estimate = rate(successes, count)
    assert estimate.value == successes / count
    assert (estimate.low, estimate.high) == (
        pytest.approx(low, abs=1e-4),
        pytest.approx(high, abs=1e-4),
    )


@pytest.mark.parametrize(("successes", "count"), [(0, 0), (2, 1), (-1, 3)])
def test_what_is_no_rate(successes: int, count: int) -> None:
    with pytest.raises(ValueError, match="no rate"):
        rate(successes, count)


def test_bootstrap_of_many_values_is_near_the_normal_interval() -> None:
    estimate = mean([float(value) for value in range(100)])
    assert estimate is not None
    # Mean 49.5, deviation 28.87, standard error 2.887.
    assert estimate.low == pytest.approx(49.5 - 1.96 * 2.887, abs=0.3)
    assert estimate.high == pytest.approx(49.5 + 1.96 * 2.887, abs=0.3)
    assert estimate == mean([float(value) for value in range(100)])
