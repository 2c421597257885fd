"""Faults of our own, the envelope, and gaps, on the vehicle."""

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from helpers.guard_facts import figures
from helpers.guard_flights import CONTRACT, HOVER, MS, NAN, GuardFlight, leaning
from mavbridge.config.flight import EnvelopeConfig
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.reasons import Code, because
from mavbridge.core.records import FloatArray
from mavbridge.core.vehicle import NEUTRAL
from mavbridge.flight.settings import TAU_S
from mavbridge.guard.values import Phase
from sitl.ardupilot.flight_modes import Mode
from sitl.vehicle.config import MID_RECEIVER_US

LEANING = leaning(0.0)


class EveryOther:
    """NaN at every other call; so often did the old bridge change hands."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, t_s: float) -> tuple[float, float, float, float]:
        self.calls += 1
        return NAN if t_s > 0.5 and self.calls % 2 else LEANING


def largest(flight: GuardFlight, since_ns: int = 0) -> float:
    """The stick farthest from its middle of all that left."""
    return max(abs(value) for _, sticks in flight.sticks_sent(since_ns) for value in sticks)


def test_nan_every_other_time_ends_the_flight_once_and_for_all() -> None:
    flight = GuardFlight(EveryOther(), on_fault="release").fly(0.2)
    flight.run(3)

    assert flight.phases() == [
        *(Phase.WAITING, Phase.PREPARING, Phase.FLYING),
        *(Phase.LEAVING, Phase.RELEASING, Phase.RELEASED),
    ]
    assert Code.UNUSABLE_CHUNKS in flight.codes
    rolls = [sticks.roll for _, sticks in flight.sticks_sent()]
    assert max(rolls) < 0.31, "the smoother is not seeded again by our own echo"


def test_nothing_but_finite_sticks_in_range_ever_leaves() -> None:
    wild = [NAN, (math.inf, 0, 0, 0), (9.0, -9.0, 0.3, 1e30), (0, 0, 0, -math.inf), LEANING]
    calls = iter(range(10**6))
    flight = GuardFlight(lambda t_s: wild[next(calls) % 5] if t_s > 0.3 else LEANING)
    flight.fly(0.2)
    flight.run(2)

    channels = {value for _, us in flight.overrides() if any(us) for value in us}
    assert min(channels) >= 985, "above the throttle's failsafe"
    assert max(channels) <= 2000
    assert all(math.isfinite(sum(sticks)) for _, sticks in flight.sticks_sent())
    assert largest(flight) <= 1.0


@pytest.mark.parametrize(
    ("gap_s", "survives"), [(0.09, True), (0.13, True), (0.24, True), (0.27, False), (0.5, False)]
)
def test_a_stall_is_bridged_by_coasting_as_long_as_the_contract_says(
    gap_s: float, survives: bool
) -> None:
    flight = GuardFlight(on_fault="release").fly()
    before_ns = flight.clock.now_ns()
    flight.is_flight_process_stopped = True
    flight.run(gap_s)
    flight.is_flight_process_stopped = False
    flight.run(1.5)

    assert (flight.phase is Phase.FLYING) == survives
    gap_ticks = [t for t in flight.ticks if before_ns < t.sent_ns and t.is_slot and t.sent]
    assert any(tick.is_coasting for tick in gap_ticks)
    assert not any(tick.missed_slots for tick in gap_ticks), "inference never costs a stick"
    if survives:
        assert min(t.sent.roll for t in gap_ticks if t.sent) > 0.29, "along the last chunk"
    else:
        found = figures(flight.reason, Code.LATE)
        assert (found["quantity"], found["place"]) == ("chunk", "flight process")
        assert (found["age_ms"], found["limit_ms"]) == (pytest.approx(255, abs=5), 250)


def test_after_a_stop_and_a_continue_nothing_stale_is_ever_sent() -> None:
    flight = GuardFlight(on_fault="hold").fly()
    before_ns = flight.clock.now_ns()
    flight.is_flight_process_stopped = True
    took_s = flight.until(lambda: flight.phase is Phase.LEAVING, within_s=0.3)
    neutral_ns = flight.clock.now_ns()
    flight.run(0.5)
    flight.is_flight_process_stopped = False
    flight.run(3)

    assert took_s < 0.27, "the stall of the contract and 20 ms"
    assert flight.phase is Phase.RELEASED
    assert largest(flight, neutral_ns) < 0.01
    assert flight.ap.mode is Mode.BRAKE
    assert flight.modes_asked(before_ns) == [Mode.BRAKE]


def test_a_policy_that_is_killed_leaves_the_vehicle_neutral_within_60_ms() -> None:
    flight = GuardFlight(on_fault="hold").fly()
    died_s = flight.t_s
    flight.die()
    flight.until(lambda: flight.guard.is_done, within_s=3)

    safe = [e for e in flight.record(died_s) if abs(e["us"][0] - 1500) <= 2]
    assert safe[0]["t_s"] - died_s < 0.06
    assert all(abs(e["us"][0] - 1500) <= 2 for e in flight.record(safe[0]["t_s"]))
    assert Code.FLIGHT_PROCESS_DIED in flight.codes
    assert flight.ap.mode is Mode.BRAKE
    assert flight.record()[-1]["us"] == MID_RECEIVER_US[:4]


# --- slow policies, which play each chunk for long


class PlayedFlight(GuardFlight):
    """A policy that plans its whole horizon: each action is that of its own time."""

    def _act(self, encoded: FloatArray, state: FloatArray, history: FloatArray) -> FloatArray:
        self._policy_clock.ahead_ns += self.solve_ns
        start_s = self.clock.now_ns() / NS_PER_S
        plan = [self.policy(start_s + 0.05 * step) for step in range(self._horizon)]
        return np.array([plan], np.float32)


def played(hz: float, *, horizon: int = 64) -> PlayedFlight:
    """A flight of a policy whose contract makes it ``hz`` chunks a second, in 150 ms each."""
    contract = replace(CONTRACT, play_s=2 / hz, horizon=horizon)
    flight = PlayedFlight(weaving, contract=contract, on_fault="release")
    flight.solve_ns = 150 * MS
    flight.launch()
    flight.run(2.5 / hz)
    flight.act("engage")
    flight.until(lambda: flight.phase is Phase.FLYING, within_s=2.0)
    return flight


def oldest_s(flight: GuardFlight) -> float:
    """Greatest age of an attitude when a stick that came from it left."""
    return max((t.sent_ns - t.state.attitude_ns) / NS_PER_S for t in flown_ticks(flight))


def flown_ticks(flight: GuardFlight) -> list[Any]:
    return [t for t in flight.sink.ticks if t.trace is not None and t.state is not None]


@pytest.mark.parametrize("hz", [1.0, 2.0, 5.0])
def test_a_slow_policy_flies_its_plan_at_the_stick_rate(hz: float) -> None:
    flight = played(hz)
    flight.run(6)

    assert flight.phase is Phase.FLYING, flight.describe()
    ticks = flown_ticks(flight)
    assert len({t.chunk_serial for t in ticks}) == pytest.approx(6 * hz, abs=2)
    assert max(b.sent_ns - a.sent_ns for a, b in pairwise(ticks)) < 16 * MS
    assert not any(t.is_coasting for t in ticks)
    assert oldest_s(flight) < 1 / hz + 0.2
    for tick in ticks:
        wanted = weaving(tick.sent_ns / NS_PER_S + TAU_S["sticks"])
        assert tick.trace.raw == pytest.approx(wanted, abs=0.05)


# --- inputs


def camera_dies(flight: GuardFlight) -> None:
    flight.features.stopped_ns = flight.clock.now_ns()


def image_freezes(flight: GuardFlight) -> None:
    flight.features.fault = because(Code.IMAGE_FROZEN, age_s=0.6)


def telemetry_ends(flight: GuardFlight) -> None:
    flight.down.is_silent = True


def sensors_freeze(flight: GuardFlight) -> None:
    flight.ap.sensors_frozen = True


@pytest.mark.parametrize(
    ("fail", "code", "known", "within_s"),
    [
        (camera_dies, Code.LATE, {"limit_ms": 300, "place": "camera"}, 0.45),
        (image_freezes, Code.IMAGE_FROZEN, {"age_s": 0.6}, 0.15),
        (
            telemetry_ends,
            Code.LATE,
            {"quantity": "attitude", "place": "link", "spent_ms": pytest.approx(150, abs=50)},
            0.25,
        ),
        (sensors_freeze, Code.ATTITUDE_FROZEN, {"limit_ms": 500}, 0.7),
    ],
)
def test_inputs_that_fail_end_the_flight_and_do_not_begin_it_again(
    fail: Callable[[GuardFlight], None], code: Code, known: dict[str, Any], within_s: float
) -> None:
    flight = GuardFlight(weaving, on_fault="release").fly()
    fail(flight)
    flight.until(lambda: flight.phase is Phase.LEAVING, within_s=within_s)
    found = figures(flight.reason, code)
    assert found | known == found
    neutral_ns = flight.clock.now_ns()
    flight.features.stopped_ns = flight.features.fault = None
    flight.down.is_silent = flight.ap.sensors_frozen = False
    flight.run(4)

    assert flight.phase is Phase.RELEASED, flight.describe()
    assert largest(flight, neutral_ns) < 0.01


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


def test_the_link_is_lost_and_neutral_and_a_mode_are_sent_all_the_same() -> None:
    """We hear nothing, the vehicle may well hear us."""
    flight = GuardFlight(on_fault="hold").fly()
    flight.down.is_silent = True
    flight.run(8)

    assert flight.ap.mode is Mode.BRAKE
    assert flight.phase is Phase.LEAVING, "it is not given up"
    flight.down.is_silent = False
    flight.run(5)
    assert flight.record()[-1]["us"] == MID_RECEIVER_US[:4]
    assert flight.sticks_sent()[-1][1] == pytest.approx(NEUTRAL, abs=0.01)
    assert flight.phase is Phase.RELEASED
