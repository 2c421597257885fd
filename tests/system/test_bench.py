"""Parts of ``make bench`` with their real processes."""

import pytest

from benchmarks.engines import time_engines
from benchmarks.flight import fly
from benchmarks.link import BARE_CLIENT, OUR_CLIENT, time_link
from mavbridge.config.policy import PolicyConfig
from mavbridge.config.rates import Rates

pytestmark = pytest.mark.system

HOVER = PolicyConfig(policy="scripted:hover", dual_rate=False)


def test_a_flight_is_measured() -> None:
    flight = fly(HOVER, Rates(rate=50.0), 1.0)
    assert (flight.asked_action_hz, flight.solves) == (50.0, "single rate, 10 steps")
    assert flight.action_hz is not None
    assert 0 < flight.action_hz < 51
    assert flight.stick_hz is not None
    assert flight.stick_hz > 50
    assert flight.lateness_ms is not None
    assert flight.lateness_ms.p50 > 0
    assert flight.guard_cpu_cores is not None
    assert 0 < flight.guard_cpu_cores < flight.cpu_cores
    assert flight.vision_hz is not None
    assert flight.vision_hz > 0


def test_an_engine_is_timed() -> None:
    timings, notes = time_engines((HOVER,), rounds=1, block_s=0.05)
    assert [one.p50_ms > 0 for one in timings] == [True]
    assert not notes


def test_our_client_answers_the_vehicle_of_the_link_test() -> None:
    link = time_link(OUR_CLIENT, attitudes=50)
    assert link.sent == 50
    # An attitude may be overtaken by the next one, and a shared host may stall.
    assert link.answered >= 25
    assert 0 < link.round_trip_ms.p50 <= link.round_trip_ms.p99 <= link.round_trip_ms.max


def test_a_bare_pymavlink_loop_is_a_client_of_the_link_test() -> None:
    assert time_link(BARE_CLIENT, attitudes=50).answered >= 25
