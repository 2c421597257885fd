"""What the flight process knows from the guard's messages."""

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from rich.console import Console

from helpers.factories import make_state, make_trace
from helpers.fakes import START_NS, ListSink
from helpers.wire import WireEnd
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.reasons import Code, because
from mavbridge.core.vehicle import ForwardedPacket, Sticks
from mavbridge.flight.history import SentHistory
from mavbridge.flight.state import Freshness
from mavbridge.flight.telemetry_cache import MAX_SOLVES, SolveInputs, TelemetryCache
from mavbridge.guard.values import Phase
from mavbridge.guard.wire import GuardError, GuardMessage, GuardStatus, GuardTick
from mavbridge.observe.terminal import FlightScreen
from mavbridge.observe.timing import FlightTiming, ObserverDrops

MS = NS_PER_MS
STICKS = Sticks(0.2, 0.2, 0.2, 0.2)
TICK = GuardTick(
    index=4,
    due_ns=START_NS,
    woke_ns=START_NS,
    decided_ns=START_NS,
    sent_ns=START_NS + MS,
    missed_slots=1,
    is_slot=True,
    is_coasting=True,
    chunk_serial=7,
    trace=make_trace(STICKS),
    sent=STICKS,
    phase=Phase.FLYING,
    reason=None,
)
WAIT = because(Code.NO_CHUNK)
OFF = because(Code.OVERRIDE_SWITCH_OFF)
NOBODY = replace(TICK, chunk_serial=None, trace=None, sent=None, phase=Phase.WAITING, reason=WAIT)
LATER = replace(TICK, index=6, due_ns=START_NS + 20 * MS, sent_ns=START_NS + 21 * MS)
SOLVE = SolveInputs(
    serial=7,
    state=make_state(START_NS - 5 * MS),
    feature_frame_id=12,
    feature_captured_ns=START_NS - 40 * MS,
    computed_ns=START_NS - MS,
    predict_ns=3 * MS,
)


class Viewed:
    """A view, and the vehicle's packets for it."""

    def __init__(self) -> None:
        self.sink = ListSink()
        self.history = SentHistory(length=2, dt_s=0.01)
        self.view = TelemetryCache(
            history=self.history,
            sink=self.sink,
            state_frame="ned_frd",
            freshness=Freshness(attitude_ns=100 * MS, velocity_ns=250 * MS),
        )
        self.end = WireEnd()

    def packets(
        self, at_ns: int = START_NS, *, height_m: float = 3.0
    ) -> tuple[ForwardedPacket, ...]:
        mav = self.end.mav
        messages = (
            mav.local_position_ned_encode(0, 0, 0, -height_m, 1, 0, 0),
            mav.highres_imu_encode(0, 0, 0, -9.8, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 7),
            mav.attitude_quaternion_encode(0, 1, 0, 0, 0, 0.1, 0, 0),
            mav.heartbeat_encode(2, 3, 81, 2, 4),
        )
        return tuple(ForwardedPacket(at_ns, at_ns - 2 * MS, self.end.pack(one)) for one in messages)

    def receive(self, *messages: Any) -> "Viewed":
        for message in messages:
            self.view.receive(message)
        return self


def test_packets_become_readings_with_the_moment_that_they_tell_about() -> None:
    viewed = Viewed().receive(Viewed().packets(height_m=7.5))
    telemetry = viewed.view.telemetry()
    for name in (
        *("ned_from_body_wxyz", "rate_body_radps"),
        *("velocity_ned_mps", "specific_force_body_mps2"),
    ):
        reading = getattr(telemetry, name)
        assert (reading.arrived_ns, reading.happened_ns) == (START_NS, START_NS - 2 * MS)
    assert telemetry.velocity_ned_mps is not None
    assert telemetry.velocity_ned_mps.values == (1.0, 0.0, 0.0)
    assert viewed.view.attitude_ns == START_NS
    assert viewed.view.height_m == 7.5


def test_bytes_that_are_no_packet_change_nothing() -> None:
    viewed = Viewed().receive((ForwardedPacket(START_NS, START_NS, b"\xfd\x05nonsense"),), ())
    assert viewed.view.attitude_ns == 0
    assert viewed.receive(viewed.packets()).view.attitude_ns == START_NS


def test_a_tick_of_flight_is_told_with_the_inputs_of_its_chunk() -> None:
    viewed = Viewed()
    viewed.view.remember(SOLVE)
    status = GuardStatus("ArduPilot", "ALT_HOLD", True, False, (1500,) * 8, STICKS)
    viewed.receive(status, replace(TICK, index=3), TICK)
    tick = viewed.sink.ticks[1]
    assert tick.state is SOLVE.state
    assert (tick.feature_frame_id, tick.predict_ns) == (12, 3 * MS)
    assert (tick.feature_captured_ns, tick.chunk_computed_ns) == (
        *(SOLVE.feature_captured_ns, SOLVE.computed_ns),
    )
    assert (tick.index, tick.missed_slots, tick.is_slot, tick.is_coasting) == (4, 1, True, True)
    assert (tick.sent, tick.trace, tick.chunk_serial) == (STICKS, TICK.trace, 7)
    assert (tick.mode, tick.armed, tick.rc_sticks) == ("ALT_HOLD", True, STICKS)
    assert tick.release_reason is None


def test_a_tick_whose_chunk_is_no_longer_remembered_is_told_without_its_inputs() -> None:
    viewed = Viewed()
    for serial in range(7, 8 + MAX_SOLVES):
        viewed.view.remember(SOLVE._replace(serial=serial))
    viewed.receive(TICK, replace(TICK, chunk_serial=8))
    forgotten, known = viewed.sink.ticks
    assert (forgotten.predict_ns, forgotten.feature_frame_id, forgotten.state) == (None,) * 3
    assert known.predict_ns == 3 * MS


@pytest.mark.parametrize(("late_ms", "is_fresh"), [(50, True), (99, False)])
def test_while_nobody_flies_ticks_have_the_newest_state_if_it_is_fresh(
    late_ms: int, is_fresh: bool
) -> None:
    viewed = Viewed()
    viewed.receive(viewed.packets(), replace(NOBODY, sent_ns=START_NS + late_ms * MS))
    (tick,) = viewed.sink.ticks
    assert (tick.state is not None) is is_fresh
    assert tick.release_reason == WAIT


@pytest.mark.parametrize("phase", list(Phase))
def test_a_reason_is_told_unless_the_policy_has_the_sticks(phase: Phase) -> None:
    (tick,) = Viewed().receive(replace(NOBODY, phase=phase)).sink.ticks
    assert tick.release_reason == (None if phase is Phase.FLYING else WAIT)


def test_ticks_are_numbered_without_gaps_and_take_the_words_along() -> None:
    viewed = Viewed().receive(
        NOBODY, GuardMessage("one"), GuardMessage("two"), NOBODY, NOBODY, GuardError("bug", "three")
    )
    assert [tick.serial for tick in viewed.sink.ticks] == [0, 1, 2]
    assert [tick.texts for tick in viewed.sink.ticks] == [(), ("one", "two"), ()]


def test_history_follows_what_was_sent() -> None:
    viewed = Viewed().receive(TICK)
    at_ns = TICK.sent_ns + 20 * MS
    assert viewed.history.resample(at_ns).tolist() == [[pytest.approx(STICKS)] * 2]
    viewed.receive(replace(NOBODY, sent_ns=at_ns))
    assert viewed.history.resample(at_ns + 10 * MS)[0, 1].tolist() == [0.0] * 4


def test_flights_are_counted_and_the_phase_is_that_of_the_guard() -> None:
    viewed = Viewed().receive(NOBODY, TICK, TICK, replace(NOBODY, phase=Phase.RELEASED), TICK)
    assert viewed.view.flights == 2
    assert viewed.view.phase is Phase.FLYING
    viewed.receive(replace(NOBODY, phase=Phase.RELEASING, reason=OFF))
    assert (viewed.view.phase, viewed.view.reason) == (Phase.RELEASING, OFF)


def test_it_is_airborne_while_the_policy_flies_and_the_vehicle_says_so() -> None:
    airborne = GuardStatus("ArduPilot", "ALT_HOLD", True, False, (), None)
    assert Viewed().receive(airborne, TICK).view.is_airborne
    assert not Viewed().receive(airborne, NOBODY).view.is_airborne
    for is_landed in (True, None):
        status = airborne._replace(is_landed=is_landed)
        assert not Viewed().receive(status, TICK).view.is_airborne


def test_an_attitude_that_has_come_is_not_waited_for() -> None:
    viewed = Viewed().receive(Viewed().packets())
    assert viewed.view.wait_for_attitude(newer_than_ns=START_NS - 1, timeout_ns=0)
    assert not viewed.view.wait_for_attitude(newer_than_ns=START_NS, timeout_ns=0)


def test_an_attitude_wakes_who_waits_for_it() -> None:
    viewed, woken, waits = Viewed(), threading.Event(), threading.Event()

    class Condition(threading.Condition):
        def wait(self, timeout: float | None = None) -> bool:
            waits.set()
            return super().wait(timeout)

    viewed.view._news = Condition()
    arguments = (viewed.view, woken.set)
    threading.Thread(target=_wait_and_tell, args=arguments, name="waits", daemon=True).start()
    assert waits.wait(10.0)
    viewed.receive(viewed.packets())
    assert woken.wait(10.0)


def _wait_and_tell(view: TelemetryCache, tell: Callable[[], None]) -> None:
    if view.wait_for_attitude(newer_than_ns=0, timeout_ns=60_000 * MS):
        tell()


def test_status_line_report_and_recording_count_the_missed_slots_of_the_flight_alone() -> None:
    """Not those before it, nor those of the way out, of the release and after it."""
    timing = FlightTiming(action_hz=100.0, vision_hz=30.0, stick_hz=100.0)
    screen = FlightScreen(Console(), action_hz=100.0, vision_hz=30.0, readonly=False)
    viewed = Viewed()
    for one in (NOBODY, TICK, LATER, replace(LATER, index=9, missed_slots=2), NOBODY, NOBODY):
        viewed.receive(one)
    leaving = replace(NOBODY, phase=Phase.LEAVING, sent=STICKS, missed_slots=10)
    viewed.receive(leaving, leaving, TICK, replace(LATER, missed_slots=0))
    for tick in viewed.sink.ticks:
        timing.emit(tick)
        screen.emit(tick)
    assert [tick.missed_slots for tick in viewed.sink.ticks] == [0, 0, 1, 2, 0, 0, 0, 0, 0, 0]
    report = timing.report(
        mode="dual",
        engine="",
        policy="",
        autopilot=None,
        link=None,
        observer_drops=ObserverDrops(rerun=None, recorder=None),
    )
    assert report.sticks.missed_slots == 3
    assert screen.status_line().plain.count("missed 3") == 1
