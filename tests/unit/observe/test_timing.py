import json
from dataclasses import asdict, fields
from operator import attrgetter
from typing import Any

import pytest

from helpers.factories import (
    START_NS,
    TICK_NS,
    make_released_tick,
    make_state,
    make_tick,
    make_vision_tick,
)
from helpers.reports import report_of
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.files import as_json
from mavbridge.core.reasons import Code, Reason, because, reason_to_json
from mavbridge.core.records import Tick
from mavbridge.core.vehicle import LinkStats, Percentiles
from mavbridge.observe.timing import MAX_RELEASES

LINK = LinkStats(
    messages_per_s={"ATTITUDE_QUATERNION": 99.9, "RC_CHANNELS": 20.0},
    lost_fraction=0.001,
    rtt_ms=None,
    sent_actions=6000,
    echo_confirmed=True,
)


NO_IMAGE, OFF = because(Code.NO_IMAGE), because(Code.OVERRIDE_SWITCH_OFF)


def frozen(age_s: float) -> Reason:
    return because(Code.IMAGE_FROZEN, age_s=age_s)


def all_equal(value: float) -> Percentiles:
    return Percentiles(p50=value, p99=value, p999=value, max=value)


def computed(index: int, after_ms: int) -> Tick:
    """Tick ``index``, with a chunk that was finished so long after that of tick 0."""
    first_ns = make_tick(0).chunk_computed_ns
    return make_tick(index, chunk_computed_ns=first_ns + after_ms * NS_PER_MS)


def sent(index: int, late_ms: int, **changes: Any) -> Tick:
    return make_tick(index, sent_ns=START_NS + index * TICK_NS + late_ms * NS_PER_MS, **changes)


OLD = {"chunk_serial": 1, "chunk_computed_ns": make_tick(1).chunk_computed_ns}
SAME = make_state(START_NS)
TICKS: dict[str, list[Tick]] = {
    "perfect": [make_tick(index) for index in range(101)],
    "stall": [make_tick(0), make_tick(1), make_tick(7, missed_slots=5, chunk_serial=2)],
    "between slots": [make_tick(0), sent(1, 7), sent(2, 9, is_slot=False), make_tick(3)],
    "slow inference": [
        *(make_tick(0), make_tick(1), make_tick(2, **OLD)),
        *(make_tick(3, is_coasting=True, **OLD), make_tick(4, chunk_serial=2)),
    ],
    "one and a half periods": [make_tick(0), computed(1, 15)],
    "late": [make_tick(0), computed(1, 16)],
    "overtaken": [make_tick(0), make_tick(2), make_tick(4)],
    "release": [make_tick(0), make_released_tick(1), make_tick(50), make_tick(51)],
    "one attitude": [make_tick(index, state=SAME) for index in range(3)],
    "readonly": [make_tick(k, sent=None, readonly=True) for k in (0, 1)],
    "refused": [make_tick(0), make_tick(1, sent=None), make_tick(2, missed_slots=1)],
    "not flown": [make_released_tick(index) for index in range(5)],
    "one tick": [make_tick(0)],
    "waits fast, flies slowly": [
        *(make_released_tick(index) for index in range(500)),
        *(make_tick(500 + 5 * k, missed_slots=4, chunk_serial=k) for k in range(11)),
        *(make_released_tick(600 + k) for k in range(9)),
    ],
    "no reason": [make_released_tick(0, release_reason=None), make_tick(1, sent=None)],
}


@pytest.mark.parametrize(
    ("name", "paths", "values"),
    [
        ("perfect", "duration_s sticks.rate_hz sticks.flying_s", (1.0, 100.0, 1.0)),
        ("perfect", "sticks.sends sticks.slots sticks.coasting_sends", (101, 101, 0)),
        ("perfect", "action.rate_hz action.chunks action.late_chunks", (100.0, 101, 0)),
        ("perfect", "sticks.lateness_ms action.predict_ms", (all_equal(2.0),) * 2),
        ("perfect", "state_age_ms state_to_wire_ms", (all_equal(3.0),) * 2),
        ("perfect", "action.period_ms feature_age_ms", (all_equal(10.0), all_equal(40.0))),
        ("perfect", "sticks.missed_slots releases", (0, ())),
        ("stall", "sticks.missed_slots sticks.slots action.chunks", (5, 8, 3)),
        ("stall", "action.late_chunks action.period_ms.max", (1, 60.0)),
        ("between slots", "sticks.sends sticks.slots sticks.lateness_ms.max", (4, 4, 7.0)),
        ("slow inference", "sticks.sends sticks.missed_slots sticks.coasting_sends", (5, 0, 1)),
        ("slow inference", "action.chunks action.late_chunks action.period_ms.max", (3, 1, 30.0)),
        ("one and a half periods", "action.late_chunks sticks.sends", (0, 2)),
        ("late", "action.late_chunks sticks.sends", (1, 2)),
        ("overtaken", "action.chunks action.late_chunks action.rate_hz", (3, 0, 100.0)),
        ("release", "action.chunks action.late_chunks", (3, 0)),
        ("one attitude", "state_to_wire_ms state_age_ms.max", (all_equal(2.0), 22.0)),
        ("readonly", "state_to_wire_ms state_age_ms", (None, all_equal(3.0))),
        ("readonly", "sticks.sends sticks.rate_hz", (2, 100.0)),
        ("refused", "sticks.sends sticks.slots sticks.missed_slots", (2, 3, 1)),
        ("refused", "sticks.rate_hz state_age_ms", (50.0, all_equal(3.0))),
        ("not flown", "feature_age_ms state_age_ms state_to_wire_ms", (None,) * 3),
        ("not flown", "action.predict_ms action.period_ms sticks.rate_hz", (None,) * 3),
        ("one tick", "action.rate_hz sticks.rate_hz action.period_ms", (None,) * 3),
        ("waits fast, flies slowly", "sticks.rate_hz sticks.flying_s", (20.0, 0.5)),
        ("waits fast, flies slowly", "sticks.sends sticks.missed_slots", (11, 40)),
        ("waits fast, flies slowly", "action.rate_hz action.late_chunks", (20.0, 10)),
        ("no reason", "release_count sticks.sends", (0, 0)),
    ],
)
def test_figures(name: str, paths: str, values: tuple[object, ...]) -> None:
    assert attrgetter(*paths.split())(report_of(*TICKS[name])) == values


def test_releases_are_transitions_since_the_first_tick() -> None:
    reasons = (NO_IMAGE, NO_IMAGE, None, frozen(0.6), OFF, None, OFF)
    report = report_of(
        *(
            make_released_tick(index, reason) if reason else make_tick(index)
            for index, reason in enumerate(reasons)
        )
    )
    assert [(each.t_s, each.reason) for each in report.releases] == [
        (0.0, NO_IMAGE),
        (0.03, frozen(0.6)),
        (0.04, OFF),
        (0.06, OFF),
    ]
    assert report.release_count == 4


def test_the_release_list_is_bounded_and_the_count_is_not() -> None:
    reasons = [frozen(index) if index % 2 else NO_IMAGE for index in range(MAX_RELEASES + 7)]
    report = report_of(*(make_released_tick(*each) for each in enumerate(reasons)))
    assert [each.reason for each in report.releases] == reasons[:MAX_RELEASES]
    assert report.release_count == MAX_RELEASES + 7


def test_vision_counts_what_was_dropped_since_its_first_frame() -> None:
    frames = (make_vision_tick(n, dropped_frames=40 + n // 10) for n in range(1, 32))
    vision = report_of(*frames).vision
    assert vision.frames == 31
    assert vision.rate_hz == pytest.approx(30.0, abs=0.01)
    assert vision.dropped_frames == 3
    assert vision.encode_ms == all_equal(20.0)


def test_the_json_holds_the_report_with_links_and_reasons_of_releases() -> None:
    report = report_of(make_released_tick(0), make_tick(1), link=LINK)
    document = json.loads(as_json(report))
    assert list(document) == [each.name for each in fields(report)]
    assert document["sticks"] == asdict(report.sticks)
    assert document["feature_age_ms"] == dict.fromkeys(("p50", "p99", "p999", "max"), 40.0)
    assert document["link"]["messages_per_s"] == {"ATTITUDE_QUATERNION": 99.9, "RC_CHANNELS": 20.0}
    assert document["releases"] == [{"t_s": 0.0, "reason": reason_to_json(NO_IMAGE)}]
    assert document["observer_drops"] == {"rerun": None, "recorder": None}
