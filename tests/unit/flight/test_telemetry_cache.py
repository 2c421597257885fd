"""What the flight process knows from the guard's messages."""

import threading
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import pytest

from helpers.factories import make_guard_tick, make_plan, make_solve, make_trace
from helpers.fakes import START_NS, ListSink, level_telemetry, samples_of, without
from mavbridge.core.clock import NS_PER_MS, MonotonicClock
from mavbridge.core.reasons import Code, because
from mavbridge.core.vehicle import Reading, Sticks, Telemetry
from mavbridge.flight.telemetry_cache import MAX_SOLVES, TelemetryCache
from mavbridge.guard.channel import SocketPort, channel_pair
from mavbridge.guard.values import Phase
from mavbridge.guard.wire import GuardDiedError, GuardStatus, Samples, encode
from policy.contract import Contract

MS = NS_PER_MS
STICKS = Sticks(0.2, 0.2, 0.2, 0.2)
TICK = make_guard_tick(
    START_NS,
    index=4,
    missed_slots=1,
    is_coasting=True,
    chunk_serial=7,
    sent_ns=START_NS + MS,
    trace=make_trace(STICKS),
    sent=STICKS,
    phase=Phase.FLYING,
)
WAIT = because(Code.NO_CHUNK)
OFF = because(Code.OVERRIDE_SWITCH_OFF)
NOBODY = replace(
    TICK, chunk_serial=None, trace=None, sent=None, phase=Phase.WAITING, release_reason=WAIT
)
LATER = replace(TICK, index=6, due_ns=START_NS + 20 * MS, sent_ns=START_NS + 21 * MS)
SOLVE = make_solve(
    7, frame_ids=((11,), (12,)), started_ns=START_NS - 4 * MS, computed_ns=START_NS - MS
)
CAPTURED_NS = START_NS - 40 * MS


class Viewed:
    """A view, and the vehicle's samples for it."""

    def __init__(self, contract: Contract | None = None, **changes: Any) -> None:
        self.sink = ListSink()
        self.view = TelemetryCache(make_plan(contract), sink=self.sink, **changes)

    def samples(self, at_ns: int = START_NS, *, height_m: float = 3.0) -> Samples:
        position = Reading(at_ns, (0.0, 0.0, -height_m))
        known = level_telemetry(at_ns)._replace(position_ned_m=position)
        return Samples(
            tuple(
                one._replace(reading=one.reading._replace(delay_ns=2 * MS))
                for one in samples_of(known)
            )
        )

    def receive(self, *messages: Any) -> "Viewed":
        for message in messages:
            self.view.receive(message)
        return self


class Awaited(NamedTuple):
    """A view with a channel of its own for samples, and the guard's end of it."""

    view: TelemetryCache
    port: SocketPort

    def send(self, telemetry: Telemetry) -> None:
        assert self.port.send(encode(Samples(samples_of(telemetry))))


def test_the_past_is_kept_by_datagram_until_it_is_taken() -> None:
    view = Viewed(Contract(observation_steps=2)).view
    first, second, third = (level_telemetry(START_NS + k * MS) for k in range(3))
    velocity = without(second, "ned_from_body_wxyz")
    view.receive(Samples(samples_of(first) + samples_of(velocity) + samples_of(third)))
    assert view.take_past(START_NS + MS) == [first]
    assert view.take_past(START_NS + 2 * MS) == [third]
    assert view.take_past(START_NS + 2 * MS) == []


def test_a_tick_of_flight_is_told_with_the_inputs_of_its_chunk() -> None:
    viewed = Viewed()
    viewed.view.remember(SOLVE, CAPTURED_NS)
    status = GuardStatus("ArduPilot", "ALT_HOLD", True, False, (1500,) * 8, STICKS)
    viewed.receive(status, replace(TICK, index=3), TICK)
    tick = viewed.sink.ticks[1]
    assert tick.state is SOLVE.state
    assert (tick.feature_frame_id, tick.predict_ns) == (12, 3 * MS)
    assert (tick.feature_captured_ns, tick.chunk_computed_ns) == (CAPTURED_NS, SOLVE.computed_ns)
    assert (tick.index, tick.missed_slots, tick.is_slot, tick.is_coasting) == (4, 1, True, True)
    assert (tick.sent, tick.trace, tick.chunk_serial) == (STICKS, TICK.trace, 7)
    assert (tick.mode, tick.armed, tick.rc_sticks) == ("ALT_HOLD", True, STICKS)
    assert tick.release_reason is None


def test_a_tick_whose_chunk_is_no_longer_remembered_is_told_without_its_inputs() -> None:
    viewed = Viewed()
    for serial in range(7, 8 + MAX_SOLVES):
        viewed.view.remember(replace(SOLVE, serial=serial), CAPTURED_NS)
    viewed.receive(TICK, replace(TICK, chunk_serial=8))
    forgotten, known = viewed.sink.ticks
    assert (forgotten.predict_ns, forgotten.feature_frame_id, forgotten.state) == (None,) * 3
    assert known.predict_ns == 3 * MS


@pytest.mark.parametrize(("late_ms", "is_fresh"), [(50, True), (99, False)])
def test_while_nobody_flies_ticks_have_the_newest_state_if_it_is_fresh(
    late_ms: int, is_fresh: bool
) -> None:
    viewed = Viewed()
    viewed.receive(viewed.samples(), replace(NOBODY, sent_ns=START_NS + late_ms * MS))
    (tick,) = viewed.sink.ticks
    assert (tick.state is not None) is is_fresh
    assert tick.release_reason == WAIT


def test_ticks_keep_the_guards_numbers_and_take_the_words_along() -> None:
    ticks = [replace(NOBODY, serial=serial) for serial in (0, 1, 4)]
    viewed = Viewed().receive(ticks[0], "one", "two", *ticks[1:], GuardDiedError("three"))
    assert [tick.serial for tick in viewed.sink.ticks] == [0, 1, 4]
    assert [tick.texts for tick in viewed.sink.ticks] == [(), ("one", "two"), ()]


def test_history_follows_what_was_sent() -> None:
    viewed = Viewed(Contract(history_len=2, history_dt_s=0.01)).receive(TICK)
    viewed.receive(replace(TICK, sent=None))  # refused by the link: the vehicle flies on
    at_ns = TICK.sent_ns + 20 * MS
    assert viewed.view.history.resample(at_ns).tolist() == [[pytest.approx(STICKS)] * 2]
    viewed.receive(replace(NOBODY, sent_ns=at_ns, phase=Phase.LEAVING))  # no setpoint was due
    assert viewed.view.history.resample(at_ns + 10 * MS)[0, 1].tolist() == [0.0] * 4


def test_the_phase_is_that_of_the_guard() -> None:
    viewed = Viewed().receive(NOBODY, TICK, TICK, replace(NOBODY, phase=Phase.RELEASED), TICK)
    assert viewed.view.phase is Phase.FLYING
    viewed.receive(replace(NOBODY, phase=Phase.RELEASING, release_reason=OFF))
    assert (viewed.view.phase, viewed.view.reason) == (Phase.RELEASING, OFF)


def test_a_vehicle_stays_found_while_a_reboot_hides_its_mode() -> None:
    unknown = GuardStatus("ArduPilot", None, False, None, (), None)
    assert not Viewed().receive(unknown).view.is_found
    assert Viewed().receive(unknown._replace(mode="LOITER"), unknown).view.is_found


def test_an_armed_vehicle_is_airborne_if_it_says_so_whoever_flies_it() -> None:
    airborne = GuardStatus("ArduPilot", "ALT_HOLD", True, False, (), None)
    for tick in (TICK, NOBODY):
        assert Viewed().receive(airborne, tick).view.is_airborne
    for change in ({"is_landed": True}, {"is_landed": None}, {"armed": False}):
        status = airborne._replace(**change)
        assert not Viewed().receive(status, TICK).view.is_airborne


@pytest.fixture
def awaited() -> Iterator[Awaited]:
    guard, flight = map(SocketPort, channel_pair())
    view = Viewed(samples=flight).view
    yield Awaited(view, guard)
    guard.close()
    flight.close()


def test_an_attitude_that_has_come_is_not_waited_for(awaited: Awaited) -> None:
    awaited.send(level_telemetry(START_NS))
    clock = MonotonicClock()
    assert awaited.view.wait_for_attitude(clock, newer_than_ns=START_NS - 1, timeout_ns=0)
    assert not awaited.view.wait_for_attitude(clock, newer_than_ns=START_NS, timeout_ns=0)


def test_an_attitude_wakes_who_waits_for_it_and_a_velocity_does_not(awaited: Awaited) -> None:
    woken = threading.Event()

    def wait() -> None:
        if awaited.view.wait_for_attitude(
            MonotonicClock(), newer_than_ns=START_NS, timeout_ns=60_000 * MS
        ):
            woken.set()

    threading.Thread(target=wait, name="waits", daemon=True).start()
    awaited.send(without(level_telemetry(START_NS + MS), "ned_from_body_wxyz"))
    assert not woken.wait(0.1)
    awaited.send(level_telemetry(START_NS + 2 * MS))
    assert woken.wait(10.0)


def test_a_tick_brings_the_samples_that_a_busy_policy_has_not_read(awaited: Awaited) -> None:
    awaited.send(level_telemetry(START_NS))
    awaited.view.receive(NOBODY)
    assert awaited.view.telemetry.attitude_arrived_ns == START_NS


def test_a_guard_that_is_gone_is_waited_for_no_longer_than_asked(awaited: Awaited) -> None:
    awaited.port.close()
    clock = MonotonicClock()
    assert not awaited.view.wait_for_attitude(clock, newer_than_ns=0, timeout_ns=20 * MS)
    assert not awaited.view.wait_for_attitude(clock, newer_than_ns=0, timeout_ns=20 * MS)


def test_missed_slots_count_between_two_ticks_of_the_flight_alone() -> None:
    """Not those before it, nor those of the way out, of the release and after it."""
    leaving = replace(NOBODY, phase=Phase.LEAVING, sent=STICKS, missed_slots=10)
    viewed = Viewed().receive(
        *(NOBODY, TICK, LATER, replace(LATER, index=9, missed_slots=2), NOBODY, NOBODY),
        *(leaving, leaving, TICK, replace(LATER, missed_slots=0)),
    )
    assert [tick.missed_slots for tick in viewed.sink.ticks] == [0, 0, 1, 2, 0, 0, 0, 0, 0, 0]
