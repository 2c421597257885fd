import json
from pathlib import Path

import pytest

from benchmarks import stick_rates
from benchmarks.loaded_flight import SLOW_EVERY, SLOW_NS, with_slow_solves
from benchmarks.results import Flight
from helpers.bench_results import make_flight
from mavbridge.config.policy import PolicyConfig
from mavbridge.config.rates import Rates
from mavbridge.core.clock import MonotonicClock
from mavbridge.core.errors import UserError
from policy.contract import Contract
from policy.protocol import PolicyRunner


class Flights:
    """Stands in for ``fly``; the load "slow" fails."""

    def __init__(self) -> None:
        self.flown: list[tuple[float, bool, str]] = []

    def __call__(
        self, _policy: PolicyConfig, rates: Rates, _s: float, *, module: str, flags: tuple[str, str]
    ) -> Flight:
        assert module == "benchmarks.loaded_flight"
        self.flown.append((rates.stick_rate, rates.realtime, flags[1]))
        if flags[1] == "slow":
            raise UserError("it was released")
        return make_flight("mavbridge", asked_stick_hz=rates.stick_rate)


@pytest.fixture
def flights(monkeypatch: pytest.MonkeyPatch) -> Flights:
    flights = Flights()
    monkeypatch.setattr(stick_rates, "fly", flights)
    return flights


def test_flies_every_case_as_often_as_asked(flights: Flights, tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    status = stick_rates.main(
        rates=(100.0, 400.0), loads=("none",), realtime=False, starts=2, json=path
    )
    assert status == 0
    assert flights.flown == [(100.0, False, "none"), (400.0, False, "none")] * 2
    cases = json.loads(path.read_text())["cases"]
    assert [case["flight"]["asked_stick_hz"] for case in cases] == [100.0, 400.0] * 2


def test_a_flight_that_fails_is_said_and_the_others_are_flown(
    flights: Flights, capsys: pytest.CaptureFixture[str]
) -> None:
    assert stick_rates.main(rates=(250.0,), loads=("slow", "busy")) == 1
    assert len(flights.flown) == 4
    assert "it was released" in capsys.readouterr().out


def test_every_tenth_solve_is_slow_and_all_are_the_policys() -> None:
    runner = PolicyRunner(
        contract=Contract(),
        name="a",
        engine="b",
        dual_rate=True,
        encode=lambda rgb: rgb,
        act=lambda *arguments: arguments[0],
    )
    slow, clock, durations_ns = with_slow_solves(runner), MonotonicClock(), []
    for number in range(2 * SLOW_EVERY):
        start_ns = clock.now_ns()
        assert slow.act(number, None, None) == number
        durations_ns.append(clock.now_ns() - start_ns)
    assert min(durations_ns[SLOW_EVERY - 1 :: SLOW_EVERY]) >= SLOW_NS
