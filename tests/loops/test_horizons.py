"""Chunks shorter than the lead of the low-pass, or than the time between solves, on the vehicle."""

import pytest

from helpers.guard_facts import figures
from helpers.guard_flights import MS, GuardFlight, leaning
from mavbridge.config.flight import Limits
from mavbridge.config.rates import Rates
from mavbridge.core.reasons import Code
from mavbridge.guard.values import Phase
from policy.contract import Contract


def flight_of(
    horizon: int, dt_s: float, hz: float, *, solve_ms: int = 3, tau: float | None = None
) -> GuardFlight:
    contract = Contract(feature_dim=1, arrays="numpy", horizon=horizon, chunk_dt_s=dt_s)
    flight = GuardFlight(
        leaning, contract=contract, rates=Rates(action_rate=hz), limits=Limits(tau=tau)
    )
    flight.solve_ns = solve_ms * MS
    return flight


@pytest.mark.parametrize(
    ("horizon", "dt_s", "hz", "solve_ms", "tau"),
    [
        (1, 0.05, 20, 3, None),
        (1, 0.0333, 30, 3, None),
        (1, 0.02, 50, 10, None),
        (1, 0.01, 100, 3, None),
        (1, 0.05, 30, 20, None),
        (2, 0.02, 100, 3, None),
        (4, 0.0125, 100, 3, 0.05),
        (2, 0.05, 30, 20, None),
        (2, 0.05, 30, 20, 0.0),
        (16, 0.05, 100, 3, 0.8),
        (16, 0.05, 100, 3, 2.0),
    ],
)
def test_a_chunk_that_covers_the_time_between_solves_is_flown_without_a_level_stick(
    horizon: int, dt_s: float, hz: float, solve_ms: int, tau: float | None
) -> None:
    flight = flight_of(horizon, dt_s, hz, solve_ms=solve_ms, tau=tau).fly(1.5)
    flown = [tick for tick in flight.ticks if tick.trace is not None]
    assert {round(tick.trace.raw.roll, 3) for tick in flown if tick.trace} == {0.3}
    assert not any(tick.is_coasting for tick in flown)


@pytest.mark.parametrize(
    ("horizon", "dt_s", "hz", "solve_ms"), [(1, 0.02, 30, 3), (2, 0.02, 30, 20), (4, 0.002, 100, 3)]
)
def test_one_that_does_not_begins_no_flight_and_arms_nothing(
    horizon: int, dt_s: float, hz: float, solve_ms: int
) -> None:
    flight = flight_of(horizon, dt_s, hz, solve_ms=solve_ms)
    flight.run(6)
    found = figures(flight.reason, Code.HORIZON_TOO_SHORT)
    found |= figures(flight.reason, Code.AFTER_HORIZON)
    assert (found["steps"], found["step_ms"]) == (horizon, pytest.approx(dt_s * 1e3))
    flight.act("engage")
    flight.run(1)
    assert flight.phases() == [Phase.WAITING]


def test_with_arm_it_gives_up_at_once_with_the_figures() -> None:
    contract = Contract(feature_dim=1, arrays="numpy", horizon=1, chunk_dt_s=0.02)
    flight = GuardFlight(leaning, contract=contract, rates=Rates(action_rate=30.0), arm=True)
    flight.until(lambda: flight.guard.failure is not None, within_s=12)
    found = figures(flight.guard.failure, Code.HORIZON_TOO_SHORT)
    assert (found["horizon_ms"], found["steps"], found["step_ms"]) == (20, 1, 20)
    assert not flight.ap.armed


def test_solves_that_become_too_slow_for_the_horizon_end_the_flight_as_coasting() -> None:
    flight = flight_of(4, 0.02, 30).fly(1.0)
    flight.solve_ns = 60 * MS
    took_s = flight.until(lambda: flight.phase is not Phase.FLYING, within_s=2)
    level = [t for t in flight.ticks if t.trace is not None and t.trace.raw.roll == 0.0]
    assert all(tick.is_coasting for tick in level)
    assert 0 < len(level) <= 13
    assert took_s < 1.0
    assert flight.guard.outcome.faults == 1
