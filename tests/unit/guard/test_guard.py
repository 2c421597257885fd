"""The guard as a whole, without I/O: what leaves at which moment."""

import math
from dataclasses import replace
from typing import Any

import pytest

from helpers.fakes import AIRBORNE_STATUS, START_NS
from helpers.guard_facts import (
    COPTER_MODES,
    PX4_MODES,
    codes,
    engagement_settings,
    flight_settings,
    limits_of,
    make_chunk,
    stick_smoothing,
)
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.vehicle import (
    IDLE,
    NEUTRAL,
    Action,
    ActionKind,
    ActionMeaning,
    AttitudeThrust,
    BodyRates,
    Decision,
    LinkSnapshot,
    ModeRoles,
    Reading,
    Release,
    Sticks,
    Telemetry,
    Velocity,
)
from mavbridge.guard.chunks import MAX_REFUSED, Chunk, FreshnessLimits, late
from mavbridge.guard.guard import Guard, GuardInput, GuardOutput
from mavbridge.guard.limits import Smoothing
from mavbridge.guard.values import EndRequest, OperatorCommand, Phase

MS = NS_PER_MS
WANTED = Sticks(0.4, 0.1, -0.2, 0.3)
SLOW = stick_smoothing(max_slew_per_s=1.0, tau_s=0.0)
PILOT = Sticks(0.1, 0.0, -0.3, 0.05)
AGES = FreshnessLimits(
    state_ns=300 * MS, velocity_ns=300 * MS, feature_ns=300 * MS, chunk_ns=300 * MS
)


class Stepped:
    """A guard of 100 Hz at times in ms since its start; attitudes and chunks are 3 ms old."""

    def __init__(
        self,
        *,
        smoothing: Smoothing | None = None,
        meaning: ActionMeaning | None = None,
        status: dict[str, Any] | None = None,
        roles: ModeRoles = COPTER_MODES,
        freshness: FreshnessLimits = AGES,
        **rules: Any,
    ) -> None:
        engagement = engagement_settings(**({"modes": ("ALT_HOLD",)} | rules))
        settings = flight_settings(
            meaning=meaning or ActionMeaning(),
            freshness=freshness,
            smoothing=smoothing or stick_smoothing(),
            engagement=engagement,
        )
        self.guard = Guard(settings, START_NS)
        self.status = replace(AIRBORNE_STATUS, **(status or {}))
        self.roles = roles
        self.telemetry = Telemetry()
        self.link: dict[str, Any] = {}
        """What the link says besides the vehicle's status."""
        self.is_released = True
        self.serial = 0
        self.outputs: list[GuardOutput] = []

    def chunk(self, at_ms: float, sticks: Action = WANTED, *, actions: int = 16) -> Chunk:
        self.serial += 1
        now_ns = START_NS + round(at_ms * MS)
        return make_chunk(self.serial, now_ns, age_ns=3 * MS, actions=(sticks,) * actions)

    def step(
        self,
        at_ms: float,
        chunk: Chunk | None = None,
        *,
        act: OperatorCommand | None = None,
        stop: EndRequest | None = None,
        fault: Reason | None = None,
        **changes: Any,
    ) -> GuardOutput:
        now_ns = START_NS + round(at_ms * MS)
        self.status = replace(self.status, **({"rc_arrived_ns": now_ns} | changes))
        link = replace(
            LinkSnapshot(
                telemetry=self.telemetry,
                status=self.status,
                problem=None,
                echo_confirmed=True,
                is_released=self.is_released,
                modes=self.roles,
            ),
            **self.link,
        )
        given = GuardInput(link=link, chunk=chunk, act=act, stop=stop, command_fault=fault)
        output = self.guard.step(now_ns, given)
        if output.decision is not None:
            self.is_released = isinstance(output.decision, Release)
        self.outputs.append(output)
        return output

    def engaged(self, *, at_ms: float = 30.0, sticks: Action = WANTED) -> "Stepped":
        """Three chunks in time, then the operator's key."""
        for k in range(3):
            self.step(at_ms - 30 + 10 * k, self.chunk(at_ms - 30 + 10 * k, sticks))
        self.step(at_ms, self.chunk(at_ms, sticks), act="engage")
        assert self.guard.engagement.phase is Phase.FLYING, self.outputs[-1].messages
        return self

    @property
    def decisions(self) -> list[Decision]:
        return [output.decision for output in self.outputs if output.decision is not None]


# --- when


def test_a_new_chunk_leaves_at_once_and_a_slot_shortly_after_it_is_left_out() -> None:
    guard = Stepped().engaged()
    early = guard.step(33, guard.chunk(33))
    assert (early.decision, early.tick.is_slot, early.tick.index) == (WANTED, False, -1)
    assert (early.tick.missed_slots, early.tick.decided_ns) == (0, START_NS + 33 * MS)
    served = guard.step(40)  # 7 ms later
    assert served.tick.index == 4
    assert served.decision == WANTED
    again = guard.step(46, guard.chunk(46))
    assert (again.decision, again.tick.is_slot) == (WANTED, False)
    left_out = guard.step(50)  # 4 ms later
    assert (left_out.decision, left_out.tick.is_slot) == (None, False)
    after = guard.step(60)
    assert (after.tick.index, after.tick.missed_slots) == (6, 0)


def asked_before_the_reset() -> tuple[Stepped, GuardOutput]:
    """An act at 30 ms, and what came of it; all chunks are of before the policy's reset."""
    guard = Stepped()
    for at_ms in (0, 10, 20):
        guard.step(at_ms, guard.chunk(at_ms)._replace(reset_ns=0))
    return guard, guard.step(30, guard.chunk(30)._replace(reset_ns=0), act="engage")


def test_the_policy_gets_the_sticks_with_its_first_chunk_after_the_reset() -> None:
    guard, asked = asked_before_the_reset()
    assert (asked.tick.phase, asked.tick.starting_ns) == (Phase.PREPARING, START_NS + 30 * MS)
    held = guard.step(40, guard.chunk(40)._replace(reset_ns=START_NS + 30 * MS - 1))
    assert (held.tick.phase, held.decision) == (Phase.PREPARING, None)
    flown = guard.step(50, guard.chunk(50)._replace(reset_ns=START_NS + 30 * MS))
    assert (flown.tick.phase, flown.tick.starting_ns) == (Phase.FLYING, 0)
    assert flown.tick.chunk_serial == 6


def test_an_act_that_was_taken_back_leaves_no_reset_for_the_next_one() -> None:
    guard, _ = asked_before_the_reset()
    given_up = guard.step(40, guard.chunk(40)._replace(reset_ns=0), act="release")
    assert given_up.tick.starting_ns == 0
    for at_ms in range(50, 2000, 10):
        guard.step(at_ms, guard.chunk(at_ms)._replace(reset_ns=START_NS + 35 * MS))
    asked = guard.step(2000, guard.chunk(2000)._replace(reset_ns=START_NS + 35 * MS), act="engage")
    assert (asked.tick.phase, asked.tick.starting_ns) == (Phase.PREPARING, START_NS + 2000 * MS)
    last = guard.step(5020).tick  # 3 s and two periods of the policy later
    assert last.phase is Phase.PREPARING


def test_a_reset_that_takes_longer_than_the_grace_is_asked_for_once() -> None:
    guard, _ = asked_before_the_reset()
    starts = {guard.step(at_ms).tick.starting_ns for at_ms in range(40, 400, 10)}
    assert starts == {START_NS + 30 * MS}
    for at_ms in range(400, 600, 10):
        output = guard.step(at_ms, guard.chunk(at_ms)._replace(reset_ns=START_NS + 35 * MS))
    assert output.tick.phase is Phase.FLYING


def test_a_chunk_that_is_not_taken_is_not_news() -> None:
    guard = Stepped().engaged()
    nan = guard.chunk(33, WANTED._replace(roll=float("nan")))
    assert guard.step(33, nan).decision is None
    assert guard.step(40).decision == WANTED


def spent(reason: Reason | None) -> tuple[Any, Any]:
    """Where the time of a late input went, and how much of it in ms."""
    assert reason is not None
    figures = dict(reason.data)
    return figures["place"], figures["spent_ms"]


def test_a_computer_that_stood_still_is_told_as_that() -> None:
    tick = Stepped().engaged().step(30 + 131).tick
    assert spent(tick.release_reason) == ("computer", 131)
    assert (tick.due_ns, tick.missed_slots) == (START_NS + 160 * MS, 12)


def test_a_guard_that_stood_still_beyond_the_grace_does_not_fly_on_with_a_fresh_chunk() -> None:
    guard = Stepped().engaged()
    stood = guard.step(30 + 2000, guard.chunk(30 + 2000))
    assert stood.decision == NEUTRAL
    assert spent(stood.tick.release_reason) == ("guard", 2000)
    assert guard.step(2040, guard.chunk(2040)).decision in (NEUTRAL, None)


STALL = replace(AGES, stall_ns=300 * MS)


def heard(at_ms: float) -> Telemetry:
    return Telemetry(ned_from_body_wxyz=Reading(START_NS + round(at_ms * MS), (1.0, 0.0, 0.0, 0.0)))


def test_a_stall_of_the_flight_process_is_flown_through_and_a_silent_vehicle_is_not() -> None:
    def flies_until_ms(heard_until_ms: int) -> int:
        guard = Stepped(freshness=STALL).engaged()
        for at_ms in range(40, 1000, 10):
            guard.telemetry = heard(min(at_ms, heard_until_ms))
            output = guard.step(at_ms)
            if guard.guard.engagement.phase is not Phase.FLYING:
                break
            assert output.tick.is_coasting == (at_ms > 50)
        silent = late("attitude", 110 * MS, 100 * MS, "link", 110 * MS)
        assert (output.tick.release_reason == silent) == (heard_until_ms < 230)
        return at_ms - 10

    assert flies_until_ms(1000) == 330, "300 ms after its last chunk"
    assert flies_until_ms(100) == 200, "100 ms after the vehicle's last attitude"


@pytest.mark.parametrize(("stood_still_ms", "flies"), [(130, True), (260, True), (301, False)])
def test_a_computer_that_stood_still_flies_on_when_chunk_and_vehicle_come_back(
    stood_still_ms: int, flies: bool
) -> None:
    guard = Stepped(freshness=STALL).engaged()
    guard.telemetry = heard(30)  # a vehicle on the same computer stood still, too
    guard.step(30 + stood_still_ms)
    assert (guard.guard.engagement.phase is Phase.FLYING) == flies
    if flies:
        fresh_ms = 60 + stood_still_ms
        guard.telemetry = heard(fresh_ms)
        assert not guard.step(fresh_ms, guard.chunk(fresh_ms)).tick.is_coasting
        assert guard.guard.engagement.phase is Phase.FLYING


@pytest.mark.parametrize(("stood_still_ms", "flies"), [(60, False), (61, True)])
def test_silence_counts_from_the_end_of_a_stall_of_more_than_60_ms(
    stood_still_ms: int, flies: bool
) -> None:
    guard = Stepped(freshness=STALL).engaged()
    guard.telemetry = heard(30)
    guard.step(30 + stood_still_ms)
    assert (guard.step(140).tick.phase is Phase.FLYING) == flies


@pytest.mark.parametrize(
    ("name", "heard_ms"),
    [
        ("attitude", {"ned_from_body_wxyz": 40, "rate_body_radps": 10}),
        ("attitude", {"rate_body_radps": 10}),
        ("velocity", {"velocity_ned_mps": 10}),
        ("velocity", {"velocity_ned_mps": 40, "specific_force_body_mps2": 10}),
    ],
)
def test_the_link_is_named_where_it_has_not_brought_one_reading_for_longest(
    name: str, heard_ms: dict[str, int]
) -> None:
    limit = "state_ns" if name == "attitude" else "velocity_ns"
    guard = Stepped(freshness=replace(AGES, **{limit: 50 * MS})).engaged()
    guard.telemetry = Telemetry(
        **{
            each: Reading(START_NS + at_ms * MS, (1.0, 0.0, 0.0, 0.0)[: 4 if "xyz" in each else 3])
            for each, at_ms in heard_ms.items()
        }
    )
    for at_ms in range(40, 150, 10):
        output = guard.step(at_ms)
    assert output.tick.release_reason == late(name, 113 * MS, 50 * MS, "link", 130 * MS)  # type: ignore[arg-type]


def test_a_link_that_delays_attitudes_is_named_for_it() -> None:
    guard = Stepped().engaged()
    guard.telemetry = Telemetry(rate_body_radps=Reading(START_NS, (0.0,) * 3, delay_ns=500 * MS))
    assert spent(guard.step(161).tick.release_reason) == ("lag", 500)


@pytest.mark.parametrize("readonly", [False, True])
def test_sticks_that_were_not_sent_are_not_gone_on_from_but_where_none_are_sent(
    readonly: bool,
) -> None:
    guard = Stepped(smoothing=SLOW, readonly=readonly).engaged()
    for at_ms in (40, 50, 60):
        guard.step(at_ms)
    guard.guard.unsent()
    output = guard.step(70)
    assert isinstance(output.decision, Sticks)
    decided = output.decision.throttle
    assert decided == pytest.approx(0.05 if readonly else 0.03)  # a slot after 0.02
    assert output.tick.missed_slots == (0 if readonly else 1)
    assert guard.step(200).tick.phase is (Phase.WAITING if readonly else Phase.LEAVING)


@pytest.mark.parametrize("every", [2, 3])
@pytest.mark.parametrize(
    ("kind", "wanted", "at_rest"),
    [
        ("sticks", WANTED, NEUTRAL),
        ("rates", BodyRates(0.5, 1.0, -0.5, 0.3), AttitudeThrust(0.4, 0.0, 0.0, 0.0)),
        ("velocity", Velocity(1.5, -1.0, 0.5, 0.2), Velocity(0.0, 0.0, 0.0, 0.0)),
    ],
)
def test_commands_reach_their_goal_though_the_link_refuses_every_second_or_third(
    every: int, kind: ActionKind, wanted: Action, at_rest: Action
) -> None:
    smoothing = Smoothing(limits=limits_of(kind), tau_s=0.05)
    guard = Stepped(meaning=ActionMeaning(kind=kind, hover_thrust=0.4), smoothing=smoothing)
    guard.engaged(sticks=wanted)

    flown: list[Decision | None] = []
    for at_ms in range(40, 4040, 10):
        chunk = guard.chunk(at_ms, wanted) if at_ms < 2040 else None
        act: OperatorCommand | None = "release" if at_ms == 2040 else None
        flown.append(guard.step(at_ms, chunk, act=act).decision)
        if at_ms // 10 % every and not isinstance(flown[-1], Release | None):
            guard.guard.unsent()
    assert flown[199] == pytest.approx(wanted, abs=0.01)
    braked = [each for each in flown if not isinstance(each, Release | None)][-1]
    assert braked == pytest.approx(at_rest, abs=0.01)


# --- what link and vehicle say


@pytest.mark.parametrize("fresh", ["mode_arrived_ns", "channels_arrived_ns", "attitude", None])
def test_a_vehicle_is_heard_by_its_newest_message_and_asked_for_a_mode_as_long(
    fresh: str | None,
) -> None:
    old = {"mode_arrived_ns": START_NS, "channels_arrived_ns": START_NS}
    guard = Stepped(status={"has_receiver": False, **old})
    guard.telemetry = heard(0)
    guard.engaged().step(31, stop=EndRequest(reason=because(Code.GUARD_DIED), end="fault"))
    for at_ms in range(40, 1000, 10):
        if fresh == "attitude":
            guard.telemetry = heard(at_ms)
        news = {fresh: START_NS + at_ms * MS} if fresh in old else {}
        guard.step(at_ms, **news)
    asked = {output.actions.mode for output in guard.outputs[-30:]}
    assert asked == ({None} if fresh is None else {None, "BRAKE"})


@pytest.mark.parametrize("fault", [None, because(Code.COMMAND_FAILED)])
def test_where_neutral_may_not_have_been_sent_px4_is_not_asked_for_a_mode_at_once(
    fault: Reason | None,
) -> None:
    status = {"mode": "ALTCTL", "has_receiver": False}
    guard = Stepped(roles=PX4_MODES, modes=("ALTCTL",), status=status).engaged()
    guard.step(40, fault=fault, stop=EndRequest(reason=because(Code.GUARD_DIED), end="fault"))
    asked_ms = [at_ms for at_ms in range(50, 1050, 10) if guard.step(at_ms).actions.mode]
    assert asked_ms[0] == (50 if fault is None else 1040)


def test_which_acts_end_neutral_sticks() -> None:
    assert Stepped().guard.ways_out == "you disarm or change the mode"
    assert Stepped().engaged().guard.ways_out == "you disarm or change the mode"
    roles = replace(PX4_MODES, is_silence_failsafe=False)
    status = {"mode": "ALTCTL", "has_receiver": True, "rc_channels_us": (1500,) * 8}
    for channel in (None, 7):
        rules = {"modes": ("ALTCTL",), "engage_channel": channel}
        guard = Stepped(roles=roles, status=status, **rules).engaged()
        assert guard.guard.ways_out == "you disarm or change the mode by a ground station"
        guard.step(40, stop=EndRequest(reason=because(Code.GUARD_DIED), end="fault"))
        assert ("or put the engage switch low" in guard.guard.ways_out) == (channel == 7)
    for at_ms in range(50, 1200, 10):
        guard.step(at_ms, rc_channels_us=())
    assert guard.guard.ways_out == "you disarm or change the mode by a ground station"


def test_the_envelope_ends_a_flight_as_a_fault() -> None:
    guard = Stepped().engaged()
    for at_ms in range(40, 740, 10):
        guard.step(at_ms, guard.chunk(at_ms), battery_problem=because(Code.BATTERY))
    assert guard.outputs[-1].tick.end == "fault"
    assert because(Code.BATTERY) in [o.tick.release_reason for o in guard.outputs]


def test_a_command_that_fails_and_chunks_that_cannot_be_used_end_a_flight() -> None:
    guard = Stepped().engaged()
    failed = guard.step(40, guard.chunk(40), fault=because(Code.COMMAND_FAILED))
    assert failed.tick.release_reason == because(Code.COMMAND_FAILED)
    guard = Stepped().engaged()
    bad = WANTED._replace(roll=math.nan)
    for at_ms in range(40, 40 + MAX_REFUSED):  # within the grace
        last = guard.step(at_ms, guard.chunk(at_ms, bad))
    assert codes(last.tick.release_reason)[0] is Code.UNUSABLE_CHUNKS


def test_a_policy_that_is_too_slow_is_not_armed_for() -> None:
    guard = Stepped(arm=True, status={"armed": False})
    for k in range(8):
        guard.step(10 * k, guard.chunk(10 * k)._replace(attitude_ns=START_NS - 400 * MS))
    assert codes(guard.guard.engagement.outcome.failure) == (Code.TOO_SLOW,)


def test_idle_sticks_that_cannot_be_made_end_the_way_into_a_flight() -> None:
    guard = Stepped(arm=True, status={"armed": False})
    guard.step(0, guard.chunk(0))
    guard.step(10, fault=because(Code.COMMAND_FAILED))
    assert guard.guard.engagement.outcome.failure == because(Code.COMMAND_FAILED)


def test_the_autopilots_takeoff_goes_by_the_height_above_the_place_of_arming() -> None:
    guard = Stepped(
        smoothing=SLOW,
        arm=True,
        takeoff_m=10.0,
        status={"armed": False, "is_landed": True, "mode": "GUIDED", "pilot_sticks": PILOT},
    )
    for at_ms in range(0, 1030, 10):
        output = guard.step(at_ms, guard.chunk(at_ms), position_ned_m=(0.0, 0.0, -2.0))
    assert output.actions.arm
    asked = guard.step(1030, guard.chunk(1030), armed=True).actions.takeoff_m
    for at_ms in range(1040, 3100, 10):
        asked = (
            guard.step(at_ms, guard.chunk(at_ms), is_landed=asked is None).actions.takeoff_m
            or asked
        )
    assert asked == 10.0
    below = guard.step(3100, guard.chunk(3100), position_ned_m=(0.0, 0.0, -10.9))
    above = guard.step(3110, guard.chunk(3110), position_ned_m=(0.0, 0.0, -11.1))
    assert (below.actions.mode, above.actions.mode) == (None, "ALT_HOLD")
    assert {below.decision, above.decision} == {NEUTRAL}
    # The sticks were ours: the policy goes on from them, and not from the receiver's.
    assert guard.step(3120, guard.chunk(3120), mode="ALT_HOLD").decision == NEUTRAL
    assert guard.guard.engagement.phase is Phase.FLYING


# --- from where

ECHO = Sticks(0.9, 0.9, 0.9, 0.9)


def first_sticks(guard: Stepped) -> Sticks:
    (first,) = guard.decisions
    assert isinstance(first, Sticks)
    return first


def test_the_policy_starts_from_the_pilots_sticks() -> None:
    guard = Stepped(smoothing=SLOW, status={"pilot_sticks": PILOT, "rc_sticks": ECHO})
    assert first_sticks(guard.engaged()) == PILOT
    moved = guard.step(40).decision
    assert isinstance(moved, Sticks)
    assert max(abs(a - b) for a, b in zip(moved, PILOT, strict=True)) <= 0.0101


@pytest.mark.parametrize(("age_ms", "first"), [(500, PILOT), (501, NEUTRAL), (None, NEUTRAL)])
def test_sticks_that_were_seen_long_ago_are_not_known(age_ms: int | None, first: Sticks) -> None:
    guard = Stepped(smoothing=SLOW, status={"pilot_sticks": PILOT})
    for k in range(3):
        guard.step(570 + 10 * k, guard.chunk(570 + 10 * k))
    arrived_ns = None if age_ms is None else START_NS + (601 - age_ms) * MS
    guard.step(601, guard.chunk(601), act="engage", rc_arrived_ns=arrived_ns)
    assert first_sticks(guard) == first


def test_after_arming_it_starts_from_idle() -> None:
    guard = Stepped(smoothing=SLOW, arm=True, status={"armed": False, "pilot_sticks": PILOT})
    for k in range(3):
        output = guard.step(10 * k, guard.chunk(10 * k))
    assert output.decision == IDLE
    assert output.actions.arm
    taken = guard.step(30, guard.chunk(30), armed=True)
    assert taken.tick.phase is Phase.FLYING
    assert taken.decision == IDLE


def test_chunks_that_are_refused_do_not_start_the_filter_anew() -> None:
    """Bad ones every other time once made roll creep up by the vehicle's own rounding."""
    guard = Stepped(smoothing=SLOW, status={"pilot_sticks": NEUTRAL, "rc_sticks": ECHO})
    guard.engaged(sticks=NEUTRAL)
    for k in range(8):
        at_ms = 40 + 10 * k
        sticks = NEUTRAL if k % 2 else NEUTRAL._replace(roll=float("nan"))
        guard.step(at_ms, guard.chunk(at_ms, sticks), rc_sticks=ECHO)
    assert guard.guard.engagement.phase is Phase.FLYING
    assert set(guard.decisions) == {NEUTRAL}


# --- which


def test_the_trace_shows_what_became_of_the_action() -> None:
    output = Stepped().engaged(sticks=Sticks(1.5, 0.0, 0.0, 0.0)).outputs[-1]
    assert output.tick.trace is not None
    assert (output.tick.trace.raw.throttle, output.tick.trace.clipped.throttle) == (1.5, 1.0)
    assert output.decision == output.tick.trace.smoothed
    assert output.tick.chunk_serial == 4


def test_beyond_the_horizon_neutral_bridges_the_rest_of_the_grace() -> None:
    guard = Stepped().engaged()
    guard.step(33, guard.chunk(33, actions=2))  # acts until 70
    sent = {at_ms: guard.step(at_ms) for at_ms in range(40, 150, 10)}
    assert {at_ms for at_ms, out in sent.items() if out.decision == WANTED} == {*(40, 50, 60, 70)}
    flown = [at_ms for at_ms, out in sent.items() if out.tick.phase is Phase.FLYING]
    assert flown == list(range(40, 140, 10))
    assert all(sent[at_ms].decision == NEUTRAL for at_ms in range(80, 150, 10))
    assert sent[140].tick.phase is Phase.LEAVING
    assert sent[140].tick.trace is None
    assert sent[140].tick.chunk_serial is None


def test_a_chunk_that_comes_while_the_sticks_are_idle_sends_nothing_between_slots() -> None:
    guard = Stepped(arm=True, status={"armed": False})
    for at_ms in (0, 10, 20):
        assert guard.step(at_ms, guard.chunk(at_ms)).decision == IDLE
    assert guard.step(23, guard.chunk(23)).decision is None


def test_coasting_is_told() -> None:
    waiting = Stepped()
    waiting.step(0, waiting.chunk(0))
    assert not waiting.step(500).tick.is_coasting  # nothing is flown
    guard = Stepped().engaged()
    told = {at_ms: guard.step(at_ms).tick.is_coasting for at_ms in range(40, 100, 10)}
    assert told == {40: False, 50: False, 60: True, 70: True, 80: True, 90: True}
    assert not guard.step(95, guard.chunk(95)).tick.is_coasting


def test_where_the_throttle_is_thrust_it_stays_until_the_safe_mode_is_there() -> None:
    guard = Stepped(modes=("STABILIZE",), status={"mode": "STABILIZE", "has_receiver": False})
    guard.engaged()
    left = guard.step(31, act="release")
    assert left.decision == NEUTRAL._replace(throttle=WANTED.throttle)
    assert left.actions.mode == "LAND"
    assert guard.step(40).decision == left.decision
    assert guard.step(50, mode="LAND").decision == NEUTRAL


def test_a_throttle_that_is_thrust_stays_down_where_the_policy_never_had_it() -> None:
    guard = Stepped(arm=True, modes=("STABILIZE",), status={"mode": "STABILIZE", "armed": False})
    guard.step(0, guard.chunk(0))
    assert guard.step(10, armed=True).decision == IDLE  # too few chunks to fly
    left = guard.step(20, act="release")
    assert (left.tick.phase, left.decision) == (Phase.LEAVING, IDLE)


def test_the_policy_is_sampled_ahead_by_the_lag_of_the_low_pass() -> None:
    guard = Stepped(smoothing=stick_smoothing(tau_s=0.05)).engaged()
    ramp = guard.chunk(40)._replace(actions=tuple(Sticks(0.01 * k, 0, 0, 0) for k in range(16)))
    trace = guard.step(40, ramp).tick.trace  # from 37 ms on, 0.01 every 20 ms
    assert trace is not None
    assert trace.raw.throttle == pytest.approx(0.0265)


def test_neutral_sticks_are_sent_at_once_but_the_horizon_is_left_within_the_limits() -> None:
    guard = Stepped(smoothing=SLOW, status={"pilot_sticks": WANTED}).engaged()
    guard.step(33, guard.chunk(33, actions=2))  # acts until 70
    (before, beyond) = (guard.step(70).decision, guard.step(80).decision)
    assert before == pytest.approx(WANTED)
    assert beyond == pytest.approx((0.39, 0.09, -0.19, 0.29))
    assert guard.step(81, act="release").decision == NEUTRAL


def test_a_landing_counts_from_the_beginning_of_each_flight() -> None:
    guard = Stepped().engaged()
    guard.step(40, guard.chunk(40))  # in the air
    for at_ms in range(50, 800, 10):
        guard.step(at_ms, guard.chunk(at_ms), is_landed=True)
    assert guard.outputs[-1].tick.phase is Phase.RELEASED
    assert guard.outputs[-1].tick.release_reason == because(Code.LANDED)
    guard.engaged(at_ms=830)  # still armed, on the ground
    for at_ms in range(840, 1600, 10):
        guard.step(at_ms, guard.chunk(at_ms))
    assert guard.outputs[-1].tick.phase is Phase.FLYING


# --- words


def test_what_is_not_watched_is_told_once_at_the_beginning() -> None:
    guard = Stepped(status={"position_ned_m": None}).engaged()
    guard.step(40, guard.chunk(40))
    told = [text for output in guard.outputs for text in output.messages]
    assert sum(text.startswith("height is not watched") for text in told) == 1


def test_the_reason_why_an_act_had_no_effect_is_told_once() -> None:
    guard = Stepped(status={"armed": False})
    (told,) = guard.step(0, guard.chunk(0), act="engage").messages
    assert "disarmed" in told
    assert guard.step(10).messages == ()


def test_absence_is_the_reason_for_not_flying() -> None:
    guard = Stepped()
    link = LinkSnapshot(telemetry=Telemetry(), status=guard.status, problem=None)
    output = guard.guard.step(START_NS, GuardInput(link=link, absence=because(Code.NO_IMAGE)))
    assert output.tick.release_reason == because(Code.NO_IMAGE)


def test_without_a_vehicle_it_waits_and_can_be_ended() -> None:
    guard = Stepped().guard
    assert list(guard.rehearse()) == []
    link = LinkSnapshot(telemetry=Telemetry(), status=None, problem=because(Code.NO_HEARTBEAT))
    waiting = guard.step(START_NS, GuardInput(link=link, act="engage"))
    assert (waiting.tick.phase, waiting.decision) == (Phase.WAITING, None)
    assert "disarmed" in waiting.messages[0]
    assert waiting.tick.release_reason == because(Code.NO_HEARTBEAT)
    ended = guard.step(
        START_NS + MS, GuardInput(link=link, stop=EndRequest(reason=because(Code.SIGNAL)))
    )
    assert (ended.tick.phase, ended.decision) == (Phase.ENDED, None)
    assert guard.engagement.outcome.failure is None


@pytest.mark.parametrize("tau_s", [0.0, 0.05])
def test_body_rates_are_bridged_by_a_level_attitude_that_is_not_filtered_with_them(
    tau_s: float,
) -> None:
    turn = BodyRates(0.5, 1.0, 0.0, 0.0)
    rates = Smoothing(limits=limits_of("rates"), tau_s=tau_s)
    guard = Stepped(meaning=ActionMeaning(kind="rates", hover_thrust=0.4), smoothing=rates)
    guard.engaged(sticks=turn)
    guard.step(40, guard.chunk(40, turn, actions=2))
    beyond = guard.step(80)
    assert beyond.decision == AttitudeThrust(0.4, 0.0, 0.0, 0.0)
    assert beyond.tick.trace is not None
    assert beyond.tick.is_coasting
    guard.step(90, guard.chunk(90, turn))
    if tau_s == 0.0:
        assert guard.decisions[0] == guard.decisions[-1] == turn


def of_velocities(mode: str, **rules: Any) -> Stepped:
    limits = limits_of("velocity")
    return Stepped(
        meaning=ActionMeaning(kind="velocity"),
        smoothing=Smoothing(limits=limits, tau_s=0.0),
        status={"mode": mode},
        roles=PX4_MODES,
        modes=("OFFBOARD",),
        is_setpoint=True,
        **rules,
    )


@pytest.mark.parametrize(("is_landed", "x_mps"), [(False, 2.95), (True, 0.0)])
def test_a_velocity_is_braked_within_the_limit_of_acceleration_but_on_the_ground(
    is_landed: bool, x_mps: float
) -> None:
    guard = of_velocities("OFFBOARD")
    guard.telemetry = Telemetry(velocity_ned_mps=Reading(START_NS, (3.0, 0.0, 0.0)))
    guard.engaged(sticks=Velocity(3.0, 0.0, 0.0, 0.0))
    braking = guard.step(40, act="release", is_landed=is_landed).decision
    assert braking == pytest.approx((x_mps, 0.0, 0.0, 0.0))


def test_neutral_velocities_on_the_way_in_begin_with_what_the_vehicle_does() -> None:
    guard = of_velocities("ALTCTL")
    guard.telemetry = Telemetry(velocity_ned_mps=Reading(START_NS, (3.0, 0.0, 0.0)))
    for at_ms in (0, 10, 20):
        guard.step(at_ms, guard.chunk(at_ms, Velocity(0.0, 0.0, 0.0, 0.0)))
    guard.telemetry = Telemetry(velocity_ned_mps=Reading(START_NS, (2.0, 0.0, 0.0)))
    entering = guard.step(30, act="engage")
    assert entering.tick.phase is Phase.PREPARING
    assert entering.decision == Velocity(2.0, 0.0, 0.0, 0.0)
    braking = guard.step(40).decision
    assert braking == pytest.approx((1.95, 0.0, 0.0, 0.0))


def test_a_velocity_that_was_idle_on_the_ground_ends_from_rest() -> None:
    guard = of_velocities("OFFBOARD", arm=True)
    guard.telemetry = Telemetry(velocity_ned_mps=Reading(START_NS, (0.3, 0.0, 0.0)))  # it drifts
    rest = Velocity(0.0, 0.0, 0.0, 0.0)
    assert guard.step(0, armed=False).decision == rest
    assert guard.step(10, armed=True).decision == rest
    left = guard.step(20, act="release", is_landed=False)
    assert (left.tick.phase, left.decision) == (Phase.LEAVING, rest)


def test_a_flight_by_velocities_begins_within_their_limits_whatever_the_vehicle_says() -> None:
    """One wrong reading would be asked for, and 20 s later still for most of it."""
    limits = limits_of("velocity")
    guard = Stepped(
        meaning=ActionMeaning(kind="velocity"), smoothing=Smoothing(limits=limits, tau_s=0.0)
    )
    guard.telemetry = Telemetry(velocity_ned_mps=Reading(START_NS, (3.4e38, 0.0, -90.0)))
    guard.engaged(sticks=Velocity(0.0, 0.0, 0.0, 0.0))
    first = guard.decisions[0]
    assert isinstance(first, Velocity)
    assert math.hypot(first.x_mps, first.y_mps) <= 8.0
    assert abs(first.z_mps) <= 3.0


def test_a_flight_by_attitudes_begins_with_the_lean_that_there_is_also_beyond_the_limit() -> None:
    limits = limits_of("attitude", setpoint_lean=math.degrees(0.5))
    guard = Stepped(
        meaning=ActionMeaning(kind="attitude", hover_thrust=0.4),
        smoothing=Smoothing(limits=limits, tau_s=0.0),
    )
    half = (math.cos(0.4), math.sin(0.4), 0.0, 0.0)
    guard.telemetry = Telemetry(ned_from_body_wxyz=Reading(START_NS, half))
    guard.engaged(sticks=AttitudeThrust(0.4, 0.0, 0.0, 0.0))
    first = guard.decisions[0]
    assert first == pytest.approx((0.4, 0.8, 0.0, 0.0))
