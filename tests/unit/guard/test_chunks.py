from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers.guard_facts import codes, make_chunk
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.vehicle import NEUTRAL, BodyRates, Reading, Sticks, Telemetry
from mavbridge.guard.chunks import (
    GRACE_PERIODS,
    LEAST_GRACE_NS,
    MAX_REFUSED,
    RECENT_GAPS,
    Chunk,
    ChunkBuffer,
    FreshnessLimits,
    late,
)

MS = NS_PER_MS
LIMITS = FreshnessLimits(
    state_ns=100 * MS, velocity_ns=250 * MS, feature_ns=300 * MS, chunk_ns=300 * MS
)
OLD_IMAGE = because(Code.TOO_OLD, quantity="image", age_ms=301.0, limit_ms=300.0)
NAN = Sticks(float("nan"), 0.0, 0.0, 0.0)
SHORT: dict[str, object] = {"actions": (NEUTRAL,) * 2, "step_ns": 20 * MS}  # acts for 35 ms
RISING = tuple(Sticks(0.0, 0.0, 0.0, 0.05 * k) for k in range(16))


def chunk(serial: int, computed_ms: int, **changes: object) -> Chunk:
    """Solved in 2 ms from an attitude 3 ms old; the roll stick rises by 1 per second."""
    usual = {"image_ns": (computed_ms - 40) * MS, "step_ns": 50 * MS, "actions": RISING}
    return make_chunk(serial, computed_ms * MS, age_ns=5 * MS, **usual | changes)


def buffer(period_ms: int = 10, limits: FreshnessLimits = LIMITS) -> ChunkBuffer:
    return ChunkBuffer(limits, period_ns=period_ms * MS, kind="sticks")


def holding(
    period_ms: int = 10, limits: FreshnessLimits = LIMITS, **changes: object
) -> ChunkBuffer:
    """A buffer with a first chunk, which came at 1000 ms."""
    held = buffer(period_ms, limits)
    held.offer(chunk(1, 1000, **changes), 1000 * MS)
    return held


def figures(reason: Reason | None, *names: str) -> tuple[object, ...]:
    """Those of a reason by their names, each to 0.01."""
    assert reason is not None
    data = dict(reason.data)
    return tuple(round(each, 2) if isinstance(each := data[n], float) else each for n in names)


def too_old(quantity: str, age_ms: float, limit_ms: float) -> Reason:
    return because(Code.TOO_OLD, quantity=quantity, age_ms=age_ms, limit_ms=limit_ms)


def test_actions_are_linear_between_their_times_and_held_at_the_ends() -> None:
    ramp = chunk(1, 1005)
    for at_ms, roll in ((900, 0.0), (1000, 0.0), (1025, 0.025), (1500, 0.5), (1900, 0.75)):
        assert ramp.action_at(at_ms * MS).roll == pytest.approx(roll)


@pytest.mark.parametrize("period_ms", [10, 20, 33, 50])
def test_a_single_action_is_held_for_its_step_from_its_arrival_and_half_a_period(
    period_ms: int,
) -> None:
    held = holding(period_ms, step_ns=period_ms * MS, actions=(NEUTRAL,))
    end_ns = 1000 * MS + period_ms * MS * 3 // 2
    assert (held.action_at(end_ns, 50 * MS), held.is_coasting(end_ns)) == (NEUTRAL, False)
    assert (held.action_at(end_ns + 1), held.is_coasting(end_ns + 1)) == (None, True)


def test_chunks_that_come_after_their_own_end_do_not_prolong_the_grace() -> None:
    held = holding()
    for serial, now_ms in enumerate(range(1010, 1110, 10), start=2):
        over = chunk(serial, now_ms, actions=(NEUTRAL,) * 4, step_ns=MS)
        assert not held.offer(over, now_ms * MS)
    assert held.fault(1100 * MS) is None
    assert held.fault(1100 * MS + 1) is not None


def test_a_horizon_that_ends_before_the_next_chunk_comes_begins_no_flight() -> None:
    for latency_ms, is_covered in ((5, True), (25, False)):
        held = buffer(33)
        for serial, now_ms in enumerate(range(1000, 1166, 33), start=1):
            first_ns = (now_ms - latency_ms) * MS
            held.offer(chunk(serial, now_ms, first_ns=first_ns, **SHORT), now_ms * MS)
        assert (held.problem(now_ms * MS) is None) == is_covered
        assert held.impossibility is None, "the solves may become faster"


def test_a_chunk_that_comes_after_its_own_end_is_told_as_that_unless_it_is_too_old() -> None:
    short: dict[str, object] = {"actions": (NEUTRAL,) * 5, "step_ns": MS}  # acts until 1000 ms
    assert buffer().offer(chunk(1, 1000, **short), 1000 * MS)
    over, now_ns = buffer(), 1000 * MS + 1
    assert not over.offer(chunk(1, 1000, **short), now_ns)
    assert over.problem(now_ns) == because(Code.AFTER_HORIZON, horizon_ms=5, steps=5, step_ms=1)
    assert not over.offer(chunk(2, 1000, attitude_ns=900 * MS, **short), now_ns)
    assert over.problem(now_ns) == too_old("attitude", 100 + 1e-6, 100)
    assert over.fault(1001 * MS) == late("attitude", 101 * MS, 100 * MS, "solve", 100 * MS)


def test_a_computer_that_is_too_slow_for_the_policy_is_told_from_one_slow_solve() -> None:
    slow = buffer()
    for serial in range(1, 5):
        slow.offer(chunk(serial, 1000 * serial, attitude_ns=(1000 * serial - 905) * MS), 0)
    assert slow.impossibility is None
    slow.offer(chunk(9, 9000, attitude_ns=8095 * MS), 9000 * MS)
    expected = because(Code.TOO_SLOW, chunks=5, age_ms=905, limit_ms=100)
    assert slow.impossibility == expected
    slow.offer(chunk(10, 9100), 9100 * MS)
    assert slow.impossibility is None
    for serial in range(11, 16):  # they count anew, and the last one just keeps the limit
        age_ms = 101 if serial < 15 else 100
        slow.offer(chunk(serial, 1000 * serial, attitude_ns=(1000 * serial - age_ms) * MS), 0)
        assert slow.impossibility is None


STALL, PLAYED = replace(LIMITS, stall_ns=300 * MS), LIMITS.while_played(NS_PER_S)


@pytest.mark.parametrize(
    ("period_ms", "limits", "steps", "rests_ms", "until_ms", "quantity"),
    [
        (10, LIMITS, 16, 1020, 1100, "attitude"),
        (500, LIMITS, 16, 1095, 1195, "attitude"),  # of 995 ms, which may be 100 ms old
        (500, PLAYED, 40, 2000, 2195, "attitude"),
        (50, PLAYED, 16, 1100, 1150, "chunk"),  # three periods
        (500, PLAYED, 16, 1795, 1895, None),  # its horizon ends at 1795 ms
        (10, STALL, 1, 1020, 1100, "attitude"),
        (10, STALL, 4, 1020, 1195, None),
        (10, STALL, 6, 1020, 1295, None),
        (10, STALL, 16, 1020, 1300, "chunk"),
    ],
)
def test_without_a_new_chunk_it_coasts_within_grace_limits_and_horizon_and_is_then_at_fault(
    period_ms: int,
    limits: FreshnessLimits,
    steps: int,
    rests_ms: int,
    until_ms: int,
    quantity: str | None,
) -> None:
    held = holding(period_ms, limits, actions=(NEUTRAL,) * steps)
    assert not held.is_coasting(rests_ms * MS)
    assert held.is_coasting((rests_ms + 1) * MS)
    assert held.fault(until_ms * MS) is None
    late = held.fault(until_ms * MS + 1)
    assert codes(late) == (Code.PAST_HORIZON if quantity is None else Code.LATE,)
    if quantity is not None:
        assert figures(late, "quantity", "spent_ms") == (quantity, until_ms - 1000)


@pytest.mark.parametrize(
    ("refusal", "heard_ms", "until_ms"),
    [
        ("absence", 1010, 1100),
        ("absence", 1130, 1220),
        ("absence", 1250, 1300),
        ("stale", 1010, 1100),
        ("stale", 1130, 1220),
        ("malformed", 1010, 1100),
        ("malformed", 1250, 1300),
    ],
)
def test_a_flight_process_that_has_no_chunk_to_give_is_not_stalled_and_gets_the_grace(
    refusal: str, heard_ms: int, until_ms: int
) -> None:
    held = holding(10, STALL)
    for serial, at_ms in enumerate((heard_ms, heard_ms + 10), start=2):
        if refusal == "absence":
            held.explain_absence(OLD_IMAGE, at_ms * MS)
        else:
            bad = {"actions": (NAN,)} if refusal == "malformed" else {"image_ns": 600 * MS}
            assert not held.offer(chunk(serial, at_ms, **bad), at_ms * MS)
    assert held.fault(until_ms * MS) is None
    assert held.fault(until_ms * MS + 1) is not None
    held.offer(chunk(9, until_ms), until_ms * MS)
    assert held.fault((until_ms + 100) * MS) is None, "the next one that may be flown ends it"


def test_gaps_after_chunks_that_end_too_early_add_up_to_100_ms() -> None:
    held = buffer(50)
    for serial, now_ms in enumerate(range(1000, 1350, 50), start=1):
        held.offer(chunk(serial, now_ms, **SHORT), now_ms * MS)
    over_ns = (now_ms + 35 + 100 - 6 * 15) * MS
    assert held.fault(over_ns) is None
    assert held.fault(over_ns + 1) is not None


def test_a_chunk_that_comes_just_as_the_last_one_ends_makes_up_for_a_gap_before_that() -> None:
    held = holding(**SHORT)  # until 1035 ms
    held.offer(chunk(2, 1085, **SHORT), 1085 * MS)
    held.offer(chunk(3, 1120, **SHORT), 1120 * MS)
    assert held.fault(1220 * MS) is None


def test_a_second_stall_is_flown_through_only_after_eight_chunks_in_time() -> None:
    held, now_ms = buffer(10, STALL), 1000
    held.offer(chunk(1, now_ms), now_ms * MS)
    now_ms += 250
    for serial in range(2, 2 + RECENT_GAPS):
        held.offer(chunk(serial, now_ms), now_ms * MS)
        assert held.fault((now_ms + 100) * MS) is None
        assert held.fault((now_ms + 101) * MS) is not None
        now_ms += 10
    for serial in (99, 100):  # the last one after just the grace
        held.offer(chunk(serial, now_ms), now_ms * MS)
        assert held.fault((now_ms + 300) * MS) is None
        now_ms += 100


def began(
    period_ms: int, *gaps_ms: int, limits: FreshnessLimits = LIMITS, **changes: object
) -> tuple[ChunkBuffer, int]:
    """A buffer with chunks so far apart, the newest with changes, and the moment that it came."""
    held, now_ms = buffer(period_ms, limits), 1000
    held.offer(chunk(1, now_ms), now_ms * MS)
    for serial, gap_ms in enumerate(gaps_ms, start=2):
        now_ms += gap_ms
        last = changes if serial == len(gaps_ms) + 1 else {}
        assert held.offer(chunk(serial, now_ms, **last), now_ms * MS)
    return held, now_ms * MS


def apart(gap_ms: int, bridged_ms: int, code: Code = Code.CHUNKS_APART) -> Reason:
    return because(code, gap_ms=gap_ms, bridged_ms=bridged_ms)


RESUMED = apart(101, 100, Code.CHUNKS_RESUMED)
TOO_SHORT = because(
    Code.HORIZON_TOO_SHORT, covered_ms=35, gap_ms=60, horizon_ms=40, steps=2, step_ms=20
)


@pytest.mark.parametrize(
    ("period_ms", "limits", "gaps_ms", "newest", "reason"),
    [
        (10, LIMITS, (), {}, because(Code.JUST_BEGUN)),
        (10, LIMITS, (10,), {}, because(Code.JUST_BEGUN)),
        (10, LIMITS, (100, 10), {}, None),  # as far apart as is bridged
        (10, LIMITS, (101, 10), {}, RESUMED),
        (10, LIMITS, (10, 101), {}, RESUMED),
        (10, LIMITS, (101, 10, 102), {}, apart(102, 100)),
        (10, LIMITS, (101, *[10] * 8), {}, None),  # the eighth gap after it forgets it
        (10, LIMITS, (101, *[10] * 7), {}, RESUMED),
        (10, LIMITS, (10, 60), SHORT, None),
        (10, LIMITS, (10, 35, 35), SHORT, None),
        (10, LIMITS, (10, 60, 60), SHORT, TOO_SHORT),  # most end before the next one
        (10, STALL, (250, 250), {}, apart(250, 100)),  # as seldom as a stall
        (500, LIMITS, (500, 500), {}, apart(500, 195, Code.CHUNKS_BEYOND_PLAN)),
    ],
)
def test_a_flight_may_begin_after_three_chunks_in_time(
    period_ms: int,
    limits: FreshnessLimits,
    gaps_ms: tuple[int, ...],
    newest: dict[str, object],
    reason: Reason | None,
) -> None:
    held, now_ns = began(period_ms, *gaps_ms, limits=limits, **newest)
    assert held.problem(now_ns) == reason


def test_without_a_new_chunk_for_the_grace_no_flight_begins_although_its_limits_are_longer() -> (
    None
):
    held, now_ns = began(10, 10, 10, attitude_ns=1020 * MS)
    assert held.problem(now_ns + 100 * MS) is None
    assert held.problem(now_ns + 100 * MS + 1) == because(Code.NO_CHUNK)


@pytest.mark.parametrize(
    ("age", "name", "limit_ms"),
    [
        ("attitude_ns", "attitude", 100),
        ("velocity_ns", "velocity", 250),
        ("image_ns", "image", 300),
        ("computed_ns", "chunk", 300),
    ],
)
def test_no_flight_begins_beyond_any_limit_of_age(age: str, name: str, limit_ms: int) -> None:
    held, now_ns = began(10, 10, 10, **{age: (1020 - limit_ms + 50) * MS})
    assert held.problem(now_ns + 50 * MS) is None
    assert held.problem(now_ns + 50 * MS + 1) == too_old(name, limit_ms + 1e-6, limit_ms)


def test_where_there_never_was_a_chunk_there_is_a_fault_and_no_action() -> None:
    assert buffer().fault(0) == late("chunk", 0, 100 * MS, "flight process", 0)
    assert buffer().action_at(0) is None
    assert not buffer().is_coasting(NS_PER_S)


@pytest.mark.parametrize(
    ("period_ms", "gap_ms", "is_fault"),
    [(10, 249, True), (10, 250, False), (500, 1249, True), (500, 1250, False)],
)
def test_unusable_chunks_count_within_a_second_or_ten_periods(
    period_ms: int, gap_ms: int, is_fault: bool
) -> None:
    held = buffer(period_ms)
    for serial in range(1, MAX_REFUSED + 1):
        held.offer(chunk(serial, 1000, actions=(NAN,)), serial * gap_ms * MS)
    held.offer(chunk(9, MAX_REFUSED * gap_ms), MAX_REFUSED * gap_ms * MS)
    assert (held.fault(MAX_REFUSED * gap_ms * MS) is not None) == is_fault


def test_five_unusable_chunks_in_a_row_count_also_where_one_came_long_before() -> None:
    held = buffer()
    for serial, at_ms in enumerate((1000, 9000, 9010, 9020, 9030, 9040), start=1):
        held.offer(chunk(serial, at_ms, actions=() if serial == 6 else (NAN,)), at_ms * MS)
    assert codes(held.fault(9040 * MS)) == (Code.UNUSABLE_CHUNKS, Code.EMPTY_CHUNK), "the last"


ages = st.integers(0, 400).map(lambda ms: ms * MS)


@given(
    period_ms=st.integers(2, 2000),
    play_ns=ages,
    stall_ns=ages,
    taken=st.tuples(ages, ages, ages),
    steps=st.integers(1, 16),
)
def test_no_action_is_flown_beyond_the_horizon_nor_100_ms_beyond_a_limit_but_for_a_stall(
    period_ms: int, play_ns: int, stall_ns: int, taken: tuple[int, int, int], steps: int
) -> None:
    limits = replace(LIMITS, stall_ns=stall_ns).while_played(play_ns)
    now_ns = 1000 * MS
    held = buffer(period_ms, limits)
    attitude_ns, image_ns, computed_ns = (now_ns - age_ns for age_ns in taken)
    offered = chunk(
        1,
        1000,
        attitude_ns=attitude_ns,
        first_ns=attitude_ns,
        image_ns=image_ns,
        computed_ns=computed_ns,
        actions=(NEUTRAL,) * steps,
    )
    kept_ns = min(
        attitude_ns + limits.state_ns, image_ns + limits.feature_ns, computed_ns + limits.chunk_ns
    )
    covers = steps == 1 or now_ns <= offered.end_ns
    assert held.offer(offered, now_ns) == (now_ns <= kept_ns and covers)
    for at_ns in range(now_ns, now_ns + 3000 * MS, 25 * MS):
        if held.fault(at_ns) is None and held.action_at(at_ns) is not None:
            held_ns = now_ns + offered.step_ns + period_ms * MS // 2
            assert at_ns <= (held_ns if steps == 1 else offered.end_ns)
            graced_ns = now_ns + max(LEAST_GRACE_NS, GRACE_PERIODS * period_ms * MS)
            graced_ns = min(graced_ns, kept_ns + LEAST_GRACE_NS)
            assert at_ns <= max(graced_ns, now_ns + stall_ns)


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"actions": (NAN,)}, Code.NOT_FINITE),
        ({"actions": (NEUTRAL, NAN, NEUTRAL)}, Code.NOT_FINITE),
        ({"actions": (NEUTRAL, BodyRates(0.5, 0.0, 0.0, 0.0))}, Code.WRONG_KIND),
        ({"actions": ()}, Code.EMPTY_CHUNK),
        ({"step_ns": 0}, Code.EMPTY_CHUNK),
    ],
    ids=["nan", "one-nan", "another-kind", "none", "step"],
)
def test_a_malformed_chunk_is_not_flown(changes: dict[str, object], code: Code) -> None:
    held = holding()
    assert held.offer(chunk(2, 1010, **changes), 1010 * MS) is False
    assert held.newest == chunk(1, 1000)
    assert held.problem(2 * NS_PER_S) == because(code)


def test_the_shortest_step_is_one_of_a_nanosecond() -> None:
    assert buffer().offer(chunk(1, 1000, step_ns=1, first_ns=1000 * MS), 1000 * MS) is True


def test_nan_every_other_time_ends_the_flight_although_good_ones_lie_between() -> None:
    held = buffer()
    faults = []
    for serial in range(1, 2 * MAX_REFUSED + 1):
        now_ms = 1000 + 10 * serial
        bad = {} if serial % 2 else {"actions": (NAN,)}
        held.offer(chunk(serial, now_ms, **bad), now_ms * MS)
        faults.append(held.fault(now_ms * MS))
    assert faults[:-1] == [None] * (2 * MAX_REFUSED - 1)
    assert faults[-1] == because(Code.UNUSABLE_CHUNKS, chunks=5, why=because(Code.NOT_FINITE))
    assert held.problem(now_ms * MS) == faults[-1], "nor may the next flight begin at once"
    held.offer(chunk(99, now_ms + 1000), (now_ms + 1000) * MS)
    assert Code.UNUSABLE_CHUNKS not in codes(held.problem((now_ms + 1000) * MS))


def test_an_older_chunk_never_replaces_a_newer_one() -> None:
    held = buffer()
    held.offer(chunk(2, 1000), 1000 * MS)
    assert held.offer(chunk(1, 1001), 1001 * MS) is False
    assert not held.offer(chunk(2, 1001), 1001 * MS)  # nor the same one twice


def test_the_reason_for_no_chunk_is_the_flight_processs_own() -> None:
    held = buffer()
    held.explain_absence(because(Code.NO_IMAGE), 0)
    assert held.problem(0) == because(Code.NO_IMAGE)
    held.offer(chunk(1, 1000), 1000 * MS)
    assert held.problem(1101 * MS) == because(Code.NO_CHUNK), "it has given one since"
    held.explain_absence(because(Code.IMAGE_FROZEN, age_s=0.6), 1010 * MS)
    assert codes(held.fault(1200 * MS)) == (Code.LATE, Code.IMAGE_FROZEN)


# --- what a fault names


@pytest.mark.parametrize(
    ("now_ms", "stood_ms", "place"),
    [
        (1104, 0, "flight process"),
        (1131, 65, "flight process"),
        (1130, 65, "computer"),  # the guard did not look either, for half of it
    ],
)
def test_who_was_silent_is_named_with_the_input_that_ran_out_first(
    now_ms: int, stood_ms: int, place: str
) -> None:
    held, spent_ms = holding(), now_ms - 1000
    assert held.lateness(1100 * MS) is None
    told = held.lateness(now_ms * MS, stood_ns=stood_ms * MS)
    names = ("quantity", "age_ms", "limit_ms", "place", "spent_ms")
    lost_ms = stood_ms if place == "computer" else spent_ms
    assert figures(told, *names) == ("attitude", spent_ms + 5, 100, place, lost_ms)


@pytest.mark.parametrize(("ago_ms", "place"), [(100, "computer"), (99, "guard")])
def test_a_chunk_of_the_second_half_of_a_stall_shows_that_the_guard_alone_stood_still(
    ago_ms: int, place: str
) -> None:
    told = holding().lateness(1200 * MS, stood_ns=200 * MS, arriving=chunk(2, 1200 - ago_ms))
    assert figures(told, "place", "spent_ms") == (place, 200)


def test_a_camera_that_delivers_nothing_is_named() -> None:
    held = holding(image_ns=710 * MS)
    held.explain_absence(OLD_IMAGE, 1100 * MS)
    told = held.lateness(1104 * MS, stood_ns=10 * MS)
    assert told == late("image", 394 * MS, 300 * MS, "camera", 390 * MS, OLD_IMAGE)


def test_a_solve_that_took_too_long_is_named() -> None:
    held = holding()
    held.offer(chunk(2, 1090, attitude_ns=940 * MS), 1090 * MS)
    assert held.fault(1104 * MS) == late("attitude", 164 * MS, 100 * MS, "solve", 150 * MS)
    held = holding()  # and where it is the longest of short delays
    held.offer(chunk(2, 1099, attitude_ns=1079 * MS, velocity_ns=840 * MS), 1099 * MS)
    assert held.fault(1104 * MS) == late("velocity", 264 * MS, 250 * MS, "solve", 20 * MS)


def lagging(lag_ns: int, arrived_ns: int) -> Telemetry:
    return Telemetry(Reading(arrived_ns, (1.0, 0.0, 0.0, 0.0), lag_ns))


def test_a_delay_of_the_link_is_no_long_solve_and_an_answer_blames_nothing() -> None:
    held = holding(attitude_ns=903 * MS)
    held.explain_absence(OLD_IMAGE, 1100 * MS)
    told = held.lateness(1104 * MS, seen=lagging(90 * MS, 1104 * MS))
    assert figures(told, "place", "spent_ms") == ("lag", 90)
    held = holding()
    held.explain_absence(OLD_IMAGE, 1100 * MS)
    told = held.lateness(1104 * MS, stood_ns=10 * MS, seen=lagging(0, 1099 * MS))
    assert str(told) == f"{OLD_IMAGE}; attitude 109 ms old (limit 100 ms)"
    for lag_ns, place in ((27 * MS, "lag"), (27 * MS - 1, "flight process")):  # a quarter of 108
        told = held.lateness(1103 * MS, seen=lagging(lag_ns, 1103 * MS))
        assert figures(told, "place") == (place,)


def test_a_grace_that_ends_within_all_limits_names_the_chunk_or_its_horizon() -> None:
    held = holding(10, LIMITS.while_played(NS_PER_S))
    assert figures(held.fault(1101 * MS), "quantity", "age_ms", "limit_ms") == ("chunk", 101, 100)
    held = holding(100, LIMITS.while_played(NS_PER_S), actions=(NEUTRAL,) * 2)
    assert held.fault(1196 * MS) == because(
        Code.PAST_HORIZON,
        quantity="chunk",
        age_ms=196,
        limit_ms=95,
        place="flight process",
        spent_ms=196,
    )
    held = holding(attitude_ns=1001 * MS)
    assert held.fault(1101 * MS) == late("chunk", 101 * MS, 100 * MS, "flight process", 101 * MS)
