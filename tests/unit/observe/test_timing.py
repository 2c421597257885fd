import json

import pytest

from helpers.factories import (
    START_NS,
    TICK_NS,
    make_released_tick,
    make_state,
    make_tick,
    make_vision_tick,
)
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.reasons import Code, Reason, because, reason_to_json
from mavbridge.core.records import Tick
from mavbridge.core.vehicle import LinkStats, Percentiles
from mavbridge.observe.timing import (
    MAX_RELEASES,
    FlightTiming,
    ObserverDrops,
    ReleaseEvent,
    TimingReport,
    report_json,
)

NO_DROPS = ObserverDrops(rerun=None, recorder=None)
LINK = LinkStats(
    messages_per_s=(("ATTITUDE_QUATERNION", 99.9), ("RC_CHANNELS", 20.0)),
    lost_fraction=0.001,
    rtt_ms=None,
    sent_overrides=6000,
    echo_confirmed=True,
    saturated=(("yaw", 0.01),),
)


NO_IMAGE, OFF = because(Code.NO_IMAGE), because(Code.OVERRIDE_SWITCH_OFF)


def frozen(age_s: float) -> Reason:
    return because(Code.IMAGE_FROZEN, age_s=age_s)


def report_of(timing: FlightTiming, link: LinkStats | None = None) -> TimingReport:
    return timing.report(
        mode="dual",
        engine="torch",
        policy="scripted",
        autopilot="ardupilot",
        link=link,
        observer_drops=NO_DROPS,
    )


def timed(*ticks: Tick) -> TimingReport:
    timing = FlightTiming(stick_hz=100, action_hz=100, vision_hz=30)
    for tick in ticks:
        timing.emit(tick)
    return report_of(timing)


def all_equal(value: float) -> Percentiles:
    return Percentiles(p50=value, p99=value, p999=value, max=value)


def test_a_perfect_flight() -> None:
    report = timed(*(make_tick(index) for index in range(101)))
    assert report.duration_s == 1.0
    sticks, action = report.sticks, report.action
    assert (sticks.rate_hz, sticks.flying_s) == (100.0, 1.0)
    assert (sticks.sends, sticks.slots, sticks.missed_slots) == (101, 101, 0)
    assert sticks.coasting_sends == 0
    assert sticks.lateness_ms == all_equal(2.0)
    assert action.rate_hz == 100.0
    assert (action.chunks, action.late_chunks) == (101, 0)
    assert action.period_ms == all_equal(10.0)
    assert action.predict_ms == all_equal(2.0)
    assert report.feature_age_ms == all_equal(40.0)
    assert report.state_age_ms == all_equal(3.0)
    assert report.state_to_wire_ms == all_equal(3.0)
    assert report.releases == ()


def test_a_stall_counts_its_slots_and_makes_its_chunk_late() -> None:
    last = (make_tick(7, missed_slots=5, chunk_serial=2), make_tick(8, chunk_serial=3))
    report = timed(make_tick(0), make_tick(1), *last)
    assert (report.sticks.missed_slots, report.sticks.slots) == (5, 9)
    assert (report.action.chunks, report.action.late_chunks) == (4, 1)
    assert report.action.period_ms is not None
    assert report.action.period_ms.max == 60.0


def test_lateness_is_that_of_slots_and_a_send_between_two_has_none() -> None:
    late = make_tick(1, sent_ns=START_NS + TICK_NS + 7 * NS_PER_MS)
    between = make_tick(2, is_slot=False, sent_ns=START_NS + 2 * TICK_NS + 9 * NS_PER_MS)
    sticks = timed(make_tick(0), late, between, make_tick(3)).sticks
    assert (sticks.sends, sticks.slots) == (4, 4)
    assert sticks.lateness_ms is not None
    assert sticks.lateness_ms.max == 7.0


def test_a_slow_inference_costs_a_late_chunk_and_no_stick() -> None:
    """Two sends go on with the chunk before; the second one coasts."""
    old = {"chunk_serial": 1, "chunk_computed_ns": make_tick(1).chunk_computed_ns}
    report = timed(
        make_tick(0),
        make_tick(1),
        make_tick(2, **old),
        make_tick(3, is_coasting=True, **old),
        make_tick(4, chunk_serial=2),
    )
    assert (report.sticks.sends, report.sticks.missed_slots) == (5, 0)
    assert report.sticks.coasting_sends == 1
    assert (report.action.chunks, report.action.late_chunks) == (3, 1)
    assert report.action.period_ms is not None
    assert report.action.period_ms.max == 30.0


@pytest.mark.parametrize(("gap_ms", "late"), [(15, 0), (16, 1)])
def test_a_chunk_is_late_beyond_one_and_a_half_periods(gap_ms: int, late: int) -> None:
    first = make_tick(0)
    assert first.chunk_computed_ns is not None
    second = make_tick(1, chunk_computed_ns=first.chunk_computed_ns + gap_ms * NS_PER_MS)
    assert timed(first, second).action.late_chunks == late


def test_a_chunk_that_was_overtaken_makes_the_next_one_not_late() -> None:
    action = timed(make_tick(0), make_tick(2), make_tick(4)).action
    assert (action.chunks, action.late_chunks, action.rate_hz) == (3, 0, 100.0)
    assert action.period_ms == all_equal(10.0)


def test_the_pause_of_a_release_is_no_late_chunk() -> None:
    report = timed(make_tick(0), make_released_tick(1), make_tick(50), make_tick(51))
    assert (report.action.chunks, report.action.late_chunks) == (3, 0)


def test_only_the_first_send_of_an_attitude_counts_as_state_to_wire() -> None:
    state = make_state(START_NS)
    report = timed(make_tick(0, state=state), make_tick(1, state=state), make_tick(2, state=state))
    assert report.state_to_wire_ms == all_equal(2.0)
    assert report.state_age_ms is not None
    assert report.state_age_ms.max == 22.0


def test_ages_of_what_was_not_flown_are_not_counted() -> None:
    report = timed(*(make_released_tick(index) for index in range(5)))
    assert report.feature_age_ms is None
    assert report.state_age_ms is None
    assert report.state_to_wire_ms is None
    assert report.action.predict_ms is None
    assert report.action.period_ms is None
    assert report.action.rate_hz is None
    assert report.sticks.rate_hz is None


def test_a_loop_that_waits_fast_and_flies_slowly_is_reported_slow() -> None:
    waiting = [make_released_tick(index) for index in range(500)]
    flying = [make_tick(500 + 5 * k, missed_slots=4, chunk_serial=k) for k in range(11)]
    report = timed(*waiting, *flying, *(make_released_tick(600 + k) for k in range(9)))
    sticks, action = report.sticks, report.action
    assert (sticks.rate_hz, sticks.flying_s) == (20.0, 0.5)
    assert (sticks.sends, sticks.missed_slots) == (11, 40)
    assert (action.rate_hz, action.late_chunks) == (20.0, 10)
    assert action.period_ms == all_equal(50.0)


def test_readonly_has_ages_but_nothing_on_the_wire() -> None:
    report = timed(make_tick(0, sent=None), make_tick(1, sent=None))
    assert report.state_to_wire_ms is None
    assert report.state_age_ms == all_equal(3.0)


def test_releases_are_transitions_since_the_first_tick() -> None:
    report = timed(
        make_released_tick(0, NO_IMAGE),
        make_released_tick(1, NO_IMAGE),
        make_tick(2),
        make_released_tick(3, frozen(0.6)),
        make_released_tick(4, OFF),
        make_tick(5),
        make_released_tick(6, OFF),
    )
    assert report.releases == (
        ReleaseEvent(t_s=0.0, reason=NO_IMAGE),
        ReleaseEvent(t_s=0.03, reason=frozen(0.6)),
        ReleaseEvent(t_s=0.04, reason=OFF),
        ReleaseEvent(t_s=0.06, reason=OFF),
    )
    assert report.release_count == 4


def test_the_release_list_is_bounded_and_the_count_is_not() -> None:
    report = timed(
        *(
            make_released_tick(index, frozen(index) if index % 2 else NO_IMAGE)
            for index in range(MAX_RELEASES + 7)
        )
    )
    assert len(report.releases) == MAX_RELEASES
    last = MAX_RELEASES - 1
    assert report.releases[-1].reason == (frozen(last) if last % 2 else NO_IMAGE)
    assert report.release_count == MAX_RELEASES + 7


def test_a_reason_whose_figures_alone_change_is_one_release() -> None:
    report = timed(*(make_released_tick(index, frozen(index / 100)) for index in range(9)))
    assert report.releases == (ReleaseEvent(t_s=0.0, reason=frozen(0.0)),)
    assert report.release_count == 1


def test_vision_counts_what_was_dropped_since_its_first_frame() -> None:
    timing = FlightTiming(stick_hz=100, action_hz=100, vision_hz=30)
    for number in range(1, 32):
        timing.emit(make_vision_tick(number, dropped_frames=40 + number // 10))
    vision = report_of(timing).vision
    assert vision.frames == 31
    assert vision.rate_hz == pytest.approx(30.0, abs=0.01)
    assert vision.dropped_frames == 3
    assert vision.encode_ms == all_equal(20.0)


def test_a_flight_without_a_tick_measured_nothing() -> None:
    report = timed()
    assert report.duration_s == 0.0
    assert report.action.rate_hz is None
    assert report.sticks.rate_hz is None
    assert report.action.period_ms is None
    assert report.vision.rate_hz is None
    assert report.vision.encode_ms is None


def test_one_tick_has_no_rate_and_no_period() -> None:
    report = timed(make_tick(0))
    assert report.action.rate_hz is None
    assert report.sticks.rate_hz is None
    assert report.action.period_ms is None


@pytest.mark.parametrize(("action_hz", "late"), [(50.0, 0), (100.0, 0), (250.0, 1)])
def test_lateness_is_against_the_rate_that_was_asked_for(action_hz: float, late: int) -> None:
    timing = FlightTiming(stick_hz=400, action_hz=action_hz, vision_hz=30)
    timing.emit(make_tick(0))
    timing.emit(make_tick(1))
    report = report_of(timing)
    assert report.action.late_chunks == late
    assert (report.sticks.target_hz, report.action.target_hz) == (400, action_hz)


def test_json_has_the_keys_of_the_report_in_order() -> None:
    timing = FlightTiming(stick_hz=100, action_hz=100, vision_hz=30)
    timing.emit(make_released_tick(0))
    timing.emit(make_tick(1))
    document = json.loads(report_json(report_of(timing, LINK)))
    assert list(document) == [
        *("duration_s", "mode", "engine", "policy", "autopilot", "outcome"),
        *("sticks", "action", "vision"),
        *("feature_age_ms", "state_age_ms", "state_to_wire_ms", "link", "releases"),
        *("release_count", "observer_drops"),
    ]
    assert list(document["sticks"]) == [
        *("target_hz", "rate_hz", "flying_s", "sends", "coasting_sends"),
        *("slots", "missed_slots", "lateness_ms"),
    ]
    assert list(document["action"]) == [
        *("target_hz", "rate_hz", "chunks", "late_chunks", "period_ms", "predict_ms")
    ]
    vision_keys = ["target_hz", "rate_hz", "frames", "dropped_frames", "encode_ms"]
    assert list(document["vision"]) == vision_keys
    assert list(document["feature_age_ms"]) == ["p50", "p99", "p999", "max"]
    assert document["link"] == {
        "unusable_packets": 0,
        "refused_signatures": 0,
        "saturated": {"yaw": 0.01},
        "vehicle_clock_offset_ns": None,
        "is_timesync_good": False,
        "slow_clock": None,
        "timesync_error_ms": None,
        "messages_per_s": {"ATTITUDE_QUATERNION": 99.9, "RC_CHANNELS": 20.0},
        "lost_fraction": 0.001,
        "rtt_ms": None,
        "sent_overrides": 6000,
        "echo_confirmed": True,
    }
    assert document["releases"] == [{"t_s": 0.0, "reason": reason_to_json(NO_IMAGE)}]
    assert document["observer_drops"] == {"rerun": None, "recorder": None}


def test_json_says_null_for_what_was_not_measured() -> None:
    document = json.loads(report_json(timed()))
    assert document["link"] is None
    for key in ("feature_age_ms", "state_age_ms", "state_to_wire_ms"):
        assert document[key] is None
    assert document["action"]["rate_hz"] is None


def test_no_reason_is_no_release() -> None:
    """A read-only flight has none before the policy has begun."""
    begin = make_released_tick(0, release_reason=None, phase="released")
    assert timed(begin, make_tick(1, sent=None)).release_count == 0
