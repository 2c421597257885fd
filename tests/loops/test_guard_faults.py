"""Faults of our own, the envelope, and gaps, on the vehicle."""

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from helpers.guard_facts import figures
from helpers.guard_flights import CONTRACT, HOVER, MS, GuardFlight
from mavbridge.config.flight import EnvelopeConfig
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.reasons import Code, because
from mavbridge.core.records import FloatArray
from mavbridge.core.vehicle import NEUTRAL
from mavbridge.flight.settings import TAU_S
from mavbridge.guard.values import Phase
from sitl.ardupilot.flight_modes import Mode
from sitl.vehicle.config import IDLE_RECEIVER_US, MID_RECEIVER_US


def largest(flight: GuardFlight, since_ns: int = 0) -> float:
    """The stick farthest from its middle of all that left."""
    return max(abs(value) for _, sticks in flight.sticks_sent(since_ns) for value in sticks)


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


# --- what is left when the guard lets go


@pytest.mark.parametrize(
    ("receiver_us", "settings", "mode"),
    [
        (MID_RECEIVER_US, {}, Mode.ALT_HOLD),
        (MID_RECEIVER_US, {"on_fault": "release"}, Mode.ALT_HOLD),
        (MID_RECEIVER_US, {"on_fault": "hold"}, Mode.BRAKE),
        (MID_RECEIVER_US, {"on_fault": "land"}, Mode.LAND),
        (MID_RECEIVER_US, {"on_fault": "rtl"}, Mode.RTL),
        (IDLE_RECEIVER_US, {}, Mode.BRAKE),
        (IDLE_RECEIVER_US, {"on_fault": "release"}, Mode.BRAKE),
    ],
)
def test_after_a_fault_neutral_then_the_mode_then_the_receivers_sticks(
    receiver_us: tuple[int, ...], settings: dict[str, Any], mode: Mode
) -> None:
    flight = GuardFlight(receiver_us=receiver_us, **settings).fly()
    before_ns, before_s = flight.clock.now_ns(), flight.t_s
    flight.stop(because(Code.CAMERA_FAILED, camera=""), is_fault=True)
    flight.until(lambda: flight.guard.is_done, within_s=5)

    sent = flight.sticks_sent(before_ns + 1)
    assert sent[0][1] == pytest.approx(NEUTRAL, abs=0.01)
    assert sent[0][0] - before_ns < 10 * MS
    assert all(sticks == pytest.approx(NEUTRAL, abs=0.01) for _, sticks in sent)
    assert flight.ap.mode is mode
    record = flight.record(before_s)
    assert record[-1]["us"] == receiver_us[:4]
    in_mode_s = next(e["t_s"] for e in record if e["mode"] == mode.name)
    theirs_s = next(
        e["t_s"] for e in record if e["us"] == receiver_us[:4] and e["t_s"] > before_s + 0.04
    )
    assert theirs_s >= in_mode_s, "the release comes after the mode is confirmed"
    assert theirs_s - before_s < 0.25
