import pytest

from helpers.factories import START_NS, TICK_NS, make_released_tick, make_state, make_tick
from mavbridge.commands.inspect.holders import holder_spans
from mavbridge.commands.inspect.moments import find_delays
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.records import Tick
from mavbridge.core.vehicle import NEUTRAL


def flown(count: int) -> list[Tick]:
    return [make_tick(index) for index in range(count)]


def test_a_flight_on_time_has_no_delays() -> None:
    assert find_delays(flown(20), stick_hz=100, action_hz=100) == ()


def late(index: int, by_ms: int, **changes: object) -> Tick:
    at_ns = START_NS + index * TICK_NS + by_ms * NS_PER_MS
    changes = {"state": make_state(START_NS + index * TICK_NS - NS_PER_MS)} | changes
    return make_tick(index, woke_ns=at_ns, sent_ns=at_ns + 2 * NS_PER_MS, **changes)


@pytest.mark.parametrize(
    ("changes", "cause"),
    [
        ({"predict_ns": 15 * NS_PER_MS}, "the policy took long"),
        ({"state": make_state(START_NS + 10 * TICK_NS + 8 * NS_PER_MS)}, "the attitude came late"),
        ({}, "the policy loop began late"),
    ],
)
def test_a_late_chunk_is_put_down_to_the_first_stage_that_was_late(
    changes: dict[str, object], cause: str
) -> None:
    ticks = [*flown(10), late(10, 9, **changes), *(make_tick(index) for index in range(11, 15))]
    (delay,) = find_delays(ticks, stick_hz=100, action_hz=100)
    assert (delay.what, delay.cause) == ("late chunk", cause)
    assert delay.delay_ms == pytest.approx(9)


def test_a_chunk_that_a_newer_one_overtook_is_not_late() -> None:
    ticks = [*flown(5), make_tick(6), make_tick(7)]
    assert find_delays(ticks, stick_hz=100, action_hz=100) == ()


@pytest.mark.parametrize(
    ("sending_ms", "cause"), [(2, "the gate woke late"), (8, "sending took long")]
)
def test_missed_slots_are_put_down_to_the_send_before_or_to_the_wake_up(
    sending_ms: int, cause: str
) -> None:
    slow = make_tick(4, sent_ns=START_NS + 4 * TICK_NS + sending_ms * NS_PER_MS)
    after = make_tick(7, missed_slots=2, chunk_serial=4, chunk_computed_ns=slow.chunk_computed_ns)
    (delay,) = find_delays([*flown(4), slow, after], stick_hz=100, action_hz=100)
    assert (delay.what, delay.count, delay.cause) == ("missed slots", 2, cause)


def test_slots_while_the_policy_does_not_fly_are_not_missed() -> None:
    ticks = [make_released_tick(0), make_tick(5, missed_slots=4)]
    assert find_delays(ticks, stick_hz=100, action_hz=100) == ()


def test_who_held_the_sticks_when() -> None:
    ticks = [
        make_released_tick(0, "waiting for an act", phase="waiting"),
        make_released_tick(1, "arming", phase="preparing", sent=NEUTRAL),
        make_tick(2, phase="flying"),
        make_tick(3, phase="flying", is_coasting=True),
        make_released_tick(4, "too old", phase="leaving", sent=NEUTRAL),
        make_released_tick(5, "too old", phase="releasing"),
        make_released_tick(6, "too old", phase="released"),
        make_released_tick(7, "another reason", phase="released"),
    ]
    spans = holder_spans(ticks, START_NS)
    names = ["pilot", "idle", "policy", "neutral", "release", "pilot"]
    assert [span.holder for span in spans] == names
    assert [span.start_s for span in spans] == pytest.approx([0.0, 0.01, 0.02, 0.04, 0.05, 0.06])
    assert [span.end_s for span in spans[:-1]] == [span.start_s for span in spans[1:]]
    assert [span.reason for span in spans[2:4]] == ["", "too old"]


def test_a_policy_that_only_looks_on_holds_nothing() -> None:
    (span,) = holder_spans([make_tick(0, sent=None), make_tick(1, sent=None)], START_NS)
    assert span.holder == "read-only"
