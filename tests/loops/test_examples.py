"""The policies in ``examples/`` fly as their first lines say."""

import math
import sys
from pathlib import Path

import pytest

from helpers.policy_servers import when_it_listens
from mavbridge.core.processes import free_port, running
from mavbridge.core.records import Event, Tick
from mavbridge.simulation.flight import SimulatedFlight
from policy.loading.load import load_policy
from policy.loading.request import LoadedPolicy, PolicyRequest
from sitl.vehicle.dynamics import BodyState

EXAMPLES = Path(__file__).parents[2] / "examples"
FLIGHT_S = 9.0
STEADY_TICKS = 300
"""The last three seconds, when the climb is over."""


def load(spec: str) -> LoadedPolicy:
    return load_policy(PolicyRequest(spec=spec, dual_rate=True), now_s=lambda: 0.0)


class TruthAtTicks:
    """A ``TickSink`` that keeps the vehicle's true state whenever the policy's sticks leave."""

    def __init__(self, flight: SimulatedFlight) -> None:
        self._flight = flight
        self.states: list[BodyState] = []

    def emit(self, event: Event) -> None:
        if isinstance(event, Tick) and event.trace is not None:
            self.states.append(self._flight.vehicle.ap.truth)


def fly(loaded: LoadedPolicy) -> list[BodyState]:
    """States of the steady part of a flight that began on the ground."""
    flight = SimulatedFlight(course_seed=3, seed=0)
    sink = TruthAtTicks(flight)
    with loaded:
        result = flight.fly(loaded.runner, max_time_s=FLIGHT_S, sinks=(sink,))
    assert result.outcome == "timed out"  # it passes no gates, and does not crash
    assert len(sink.states) > 2 * STEADY_TICKS
    return sink.states[-STEADY_TICKS:]


def turned_deg(states: list[BodyState]) -> float:
    """Turn of the level vehicle, nose right positive."""
    rates = [body.rate_body_radps[2] for body in states]
    return math.degrees(sum(rates) / len(rates)) * STEADY_TICKS / 100


def assert_holds_3_m(states: list[BodyState]) -> None:
    heights_m = [-body.position_ned_m[2] for body in states]
    assert 2.5 < min(heights_m) <= max(heights_m) < 3.3


def test_the_numpy_policy_climbs_and_turns() -> None:
    states = fly(load(f"{EXAMPLES}/numpy_policy.py:ClimbAndTurn"))
    assert_holds_3_m(states)
    assert turned_deg(states) > 20


def test_the_torch_policy_climbs_and_looks_for_light() -> None:
    loaded = load(f"{EXAMPLES}/torch_policy.py:TowardsLight")
    assert loaded.runner.dual_rate
    assert loaded.runner.engine == "torch"
    assert_holds_3_m(fly(loaded))


def test_the_server_policy_climbs_and_turns(tmp_path: Path) -> None:
    for package in ("websockets", "msgpack"):
        pytest.importorskip(package)
    port = free_port()
    command = (sys.executable, str(EXAMPLES / "server_policy.py"), str(port))
    with running(*command, log=tmp_path / "server.log"):
        states = fly(when_it_listens(lambda: load(f"ws://127.0.0.1:{port}")))
    assert_holds_3_m(states)
    assert turned_deg(states) > 20
