"""Faults of our own, the envelope, and gaps, on the vehicle."""

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from helpers.guard_facts import figures
from helpers.guard_flights import CONTRACT, HOVER, MS, GuardFlight, leaning
from mavbridge.config.flight import EnvelopeConfig
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.reasons import Code
from mavbridge.core.records import FloatArray
from mavbridge.core.vehicle import NEUTRAL
from mavbridge.flight.settings import TAU_S
from mavbridge.guard.values import Phase
from sitl.ardupilot.flight_modes import Mode
from sitl.vehicle.config import IDLE_RECEIVER_US

# --- slow policies, which play each chunk for long


class PlayedFlight(GuardFlight):
    """A policy that plans its whole horizon: each action is that of its own time."""

    def _act(self, encoded: FloatArray, state: FloatArray, history: FloatArray) -> FloatArray:
        self._policy_clock.ahead_ns += self.solve_ns
        start_s = self.clock.now_ns() / NS_PER_S
        plan = [self.policy(start_s + 0.05 * step) for step in range(self._horizon)]
        return np.array([plan], np.float32)


def flown_ticks(flight: GuardFlight) -> list[Any]:
    return [t for t in flight.sink.ticks if t.trace is not None and t.state is not None]


@pytest.mark.parametrize("hz", [1.0, 2.0, 5.0])
def test_a_slow_policy_flies_its_plan_at_the_stick_rate(hz: float) -> None:
    """It makes ``hz`` chunks a second, in 150 ms each, and plays each for two periods."""
    contract = replace(CONTRACT, play_s=2 / hz, horizon=64)
    flight = PlayedFlight(weaving, contract=contract, on_fault="release")
    flight.solve_ns = 150 * MS
    flight.launch()
    flight.run(2.5 / hz)
    flight.act("engage")
    flight.until(lambda: flight.phase is Phase.FLYING, within_s=2.0)
    flight.run(6)

    assert flight.phase is Phase.FLYING, flight.describe()
    ticks = flown_ticks(flight)
    assert len({t.chunk_serial for t in ticks}) == pytest.approx(6 * hz, abs=2)
    assert max(b.sent_ns - a.sent_ns for a, b in pairwise(ticks)) < 16 * MS
    assert not any(t.is_coasting for t in ticks)
    ages_s = [(t.sent_ns - t.state.attitude_ns) / NS_PER_S for t in ticks]
    assert max(ages_s) < 1 / hz + 0.2
    for tick in ticks:
        wanted = weaving(tick.sent_ns / NS_PER_S + TAU_S["sticks"])
        assert tick.trace.raw == pytest.approx(wanted, abs=0.05)


# --- inputs


def test_an_attitude_that_freezes_ends_the_flight_and_does_not_begin_it_again() -> None:
    flight = GuardFlight(weaving, on_fault="release").fly()
    flight.ap.sensors_frozen = True
    flight.until(lambda: flight.phase is Phase.LEAVING, within_s=0.7)
    assert figures(flight.reason, Code.ATTITUDE_FROZEN)["limit_ms"] == 500
    neutral_ns = flight.clock.now_ns()
    flight.ap.sensors_frozen = False
    flight.run(4)

    assert flight.phase is Phase.RELEASED, flight.describe()
    for _, sticks in flight.sticks_sent(neutral_ns):
        assert sticks == pytest.approx(NEUTRAL, abs=0.01)


def weaving(t_s: float) -> tuple[float, float, float, float]:
    """Never at rest, so that its state never stands still."""
    return (0.0, 0.0, 0.0, 0.3 * math.sin(6.0 * t_s))


# --- the envelope


def by_height(_: float) -> tuple[float, float, float, float]:
    return (0.9, 0.0, 0.0, 0.0)


def by_speed(_: float) -> tuple[float, float, float, float]:
    return (0.0, 0.0, 0.9, 0.0)


@pytest.mark.parametrize(
    ("policy", "envelope", "quantity", "limit"),
    [
        (by_speed, EnvelopeConfig(max_tilt=10), "tilt", 10),
        (by_height, EnvelopeConfig(max_height=12), "height", 12),
        (by_speed, EnvelopeConfig(max_speed=3), "speed", 3),
        (by_speed, EnvelopeConfig(max_distance=5), "distance", 5),
    ],
)
def test_leaving_the_envelope_ends_the_flight(
    policy: Callable[[float], tuple[float, float, float, float]],
    envelope: EnvelopeConfig,
    quantity: str,
    limit: float,
) -> None:
    flight = GuardFlight(policy, envelope=envelope, on_fault="hold").launch()
    flight.act("engage")
    flight.until(lambda: flight.phase is Phase.LEAVING, within_s=8)
    found = figures(flight.reason, Code.BEYOND)
    assert (found["quantity"], found["limit"]) == (quantity, limit)
    assert limit < float(str(found["value"])) < 2 * limit
    flight.run(2)
    assert flight.ap.mode is Mode.BRAKE


def test_a_landing_under_the_policy_is_a_normal_end() -> None:
    flight = GuardFlight(lambda t_s: HOVER if t_s < 1.0 else (-0.8, 0.0, 0.0, 0.0)).fly()
    flight.until(lambda: flight.phase is Phase.RELEASED, within_s=15)

    assert flight.codes == (Code.LANDED,)
    assert not flight.modes_asked()


@pytest.mark.parametrize(
    ("end", "mode"), [(GuardFlight.die, Mode.BRAKE), (GuardFlight.stop, Mode.LAND)]
)
def test_over_an_idle_receiver_no_ending_lets_the_vehicle_fall(
    end: Callable[[GuardFlight], None], mode: Mode
) -> None:
    """The catalogue of faults judges every ending so, with every receiver, in real time."""
    flight = GuardFlight(leaning).launch()
    flight.receiver(ch3=IDLE_RECEIVER_US[2])
    flight.run(0.2)
    flight.act("engage")
    flight.run(1.2)
    assert flight.phase is Phase.FLYING, flight.describe()
    end(flight)
    height_m = flight.height_m
    flight.run(10)
    assert flight.ap.mode is mode, flight.describe()
    assert mode is Mode.LAND or height_m - flight.height_m < 2.0
    assert flight.summary["impact_speed_mps"] <= 1.0
