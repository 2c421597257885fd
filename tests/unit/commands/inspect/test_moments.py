from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from helpers.factories import START_NS, TICK_NS, make_released_tick, make_state, make_tick
from mavbridge.commands.inspect.analysis import holder_spans
from mavbridge.commands.inspect.moments import Arrivals, find_delays
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.reasons import Code, because
from mavbridge.core.records import Tick
from mavbridge.core.vehicle import NEUTRAL, Velocity


def flown(count: int) -> list[Tick]:
    return [make_tick(index) for index in range(count)]


@pytest.mark.parametrize(
    "ticks",
    [
        pytest.param(flown(20), id="on time"),
        pytest.param([*flown(5), make_tick(6, serial=5), make_tick(7, serial=6)], id="overtaken"),
        pytest.param([*flown(5), make_tick(60, missed_slots=1, chunk_serial=7)], id="rows lost"),
        pytest.param([make_released_tick(0), make_tick(5, missed_slots=4)], id="nobody flew"),
    ],
)
def test_what_is_no_delay_of_ours_is_none(ticks: list[Tick]) -> None:
    assert find_delays(ticks, stick_hz=100, action_hz=100) == ()


def late(index: int, by_ms: int, **changes: object) -> Tick:
    at_ns = START_NS + index * TICK_NS + by_ms * NS_PER_MS
    changes = {"state": make_state(START_NS + index * TICK_NS - NS_PER_MS)} | changes
    return make_tick(index, woke_ns=at_ns, sent_ns=at_ns + 2 * NS_PER_MS, **changes)


def stamps(*after_start_ms: float) -> NDArray[np.int64]:
    return START_NS + np.array([round(ms * NS_PER_MS) for ms in after_start_ms], np.int64)


def arrivals(**late_ms: float) -> Arrivals:
    """Attitudes 1 ms before each tick, which arrive at once; ``a10=9``: tick 10's 9 ms later."""
    happened_ms = [10 * index - 1 for index in range(20)]
    arrived_ms = [ms + late_ms.get(f"a{index}", 0) for index, ms in enumerate(happened_ms)]
    return Arrivals(stamps(*happened_ms), stamps(*arrived_ms))


@pytest.mark.parametrize(
    ("changes", "known", "cause"),
    [
        ({"predict_ns": 15 * NS_PER_MS}, arrivals(), "the policy took long"),
        ({}, arrivals(a10=10), "the attitude came late"),
        ({}, arrivals(), "the policy loop began late"),
        # A loop that began late, and took the newest attitude then, had older ones to begin with.
        (
            {"state": make_state(START_NS + 10 * TICK_NS + 8 * NS_PER_MS)},
            Arrivals(stamps(89, 99, 108), stamps(89, 99, 108)),
            "the policy loop began late",
        ),
        ({}, None, "the attitude or the policy loop was late"),
        ({}, Arrivals(stamps(89), stamps(89)), "the attitude or the policy loop was late"),
    ],
)
def test_a_late_chunk_is_put_down_to_the_stage_that_cost_most(
    changes: dict[str, object], known: Arrivals | None, cause: str
) -> None:
    ticks = [*flown(10), late(10, 9, **changes), *(make_tick(index) for index in range(11, 15))]
    (delay,) = find_delays(ticks, stick_hz=100, action_hz=100, arrivals=known)
    assert (delay.what, delay.cause) == ("late chunk", cause)
    assert delay.severity_ms == pytest.approx(9)


def test_a_chunk_after_a_long_solve_is_late_by_that_solve() -> None:
    # The solve of tick 10 begins on time and takes 32 ms; the next one has to wait for it.
    first = make_tick(10, chunk_computed_ns=START_NS + 132 * NS_PER_MS, predict_ns=32 * NS_PER_MS)
    held = [replace(first, serial=10 + k, woke_ns=first.woke_ns + k * TICK_NS) for k in range(4)]
    after = late(11, 38, serial=14, chunk_computed_ns=START_NS + 150 * NS_PER_MS)
    delays = find_delays(
        [*flown(10), *held, after], stick_hz=100, action_hz=100, arrivals=arrivals()
    )
    assert [delay.cause for delay in delays] == ["the policy took long"] * 2


@pytest.mark.parametrize(
    ("sending_ms", "changes", "cause"),
    [
        (2, {}, "the guard woke late"),
        (8, {}, "sending took long"),
        (8, {"sent": None}, "the link refused the command"),
    ],
)
def test_missed_slots_are_put_down_to_the_send_before_or_to_the_wake_up(
    sending_ms: int, changes: dict[str, Any], cause: str
) -> None:
    slow = make_tick(4, sent_ns=START_NS + 4 * TICK_NS + sending_ms * NS_PER_MS, **changes)
    after = make_tick(
        7, serial=5, missed_slots=2, chunk_serial=4, chunk_computed_ns=slow.chunk_computed_ns
    )
    (delay,) = find_delays([*flown(4), slow, after], stick_hz=100, action_hz=100)
    assert (delay.what, delay.count, delay.cause) == ("2 missed slots", 2, cause)


def test_who_held_the_sticks_when() -> None:
    old = because(Code.TOO_OLD, quantity="attitude", age_ms=104.0, limit_ms=100.0)
    ticks = [
        make_released_tick(0, because(Code.NOT_ENGAGED), phase="waiting"),
        make_released_tick(1, because(Code.WAITING_FOR_ARMING), phase="preparing", sent=NEUTRAL),
        make_tick(2, phase="flying"),
        make_tick(3, phase="flying", sent=None),
        make_released_tick(4, old, phase="leaving"),  # both refused by the link
        make_released_tick(5, old, phase="releasing"),
        make_released_tick(6, old, phase="released"),
        make_released_tick(7, because(Code.DISARMED), phase="released"),
    ]
    spans = holder_spans(ticks, START_NS, keeps_neutral=True)
    names = ["pilot", "idle", "policy", "neutral", "release", "pilot"]
    assert [span.holder for span in spans] == names
    assert [span.start_s for span in spans] == pytest.approx([0.0, 0.01, 0.02, 0.04, 0.05, 0.06])
    assert [span.end_s for span in spans[:-1]] == [span.start_s for span in spans[1:]]
    assert [span.reason for span in spans[2:4]] == [None, old]
    (looking_on,) = holder_spans(
        [make_tick(0, sent=None, readonly=True)], START_NS, keeps_neutral=True
    )
    assert looking_on.holder == "read-only"
    setpoint = Velocity(1.0, 0.0, 0.0, 0.0)
    setpoints = [make_tick(0, sent=setpoint), make_released_tick(1, old, phase="leaving")]
    for keeps, holder in ((False, "pilot"), (True, "neutral")):
        spans = holder_spans(setpoints, START_NS, keeps_neutral=keeps)
        assert [span.holder for span in spans] == ["policy", holder]


def test_of_several_reasons_the_one_that_lasted_is_told() -> None:
    rising = [because(Code.TAKING_OFF, height_m=2.0 + k) for k in range(5)]
    reasons = [because(Code.NO_HEARTBEAT), *rising, because(Code.NO_CHUNK)]
    ticks = [make_released_tick(k, reason, phase="preparing") for k, reason in enumerate(reasons)]
    (span,) = holder_spans(ticks, START_NS, keeps_neutral=True)
    assert (span.holder, span.reason) == ("pilot", rising[-1])
    assert span.end_s == pytest.approx(0.06)
