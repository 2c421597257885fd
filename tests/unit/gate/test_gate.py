"""The gate as a whole, without I/O: what leaves at which moment."""

import math
from dataclasses import replace
from typing import Any

import pytest

from helpers.fakes import AIRBORNE_STATUS, START_NS
from helpers.gate_facts import COPTER_MODES, PX4_MODES, engagement_settings, stick_smoothing
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.vehicle import (
    IDLE,
    NEUTRAL,
    Action,
    ActionMeaning,
    AttitudeThrust,
    BodyRates,
    Command,
    Decision,
    LinkSnapshot,
    ModeRoles,
    Reading,
    Release,
    Sticks,
    Telemetry,
    Velocity,
)
from mavbridge.gate.chunks import Chunk, FreshnessLimits
from mavbridge.gate.departure import DepartureSettings, Ending
from mavbridge.gate.engagement import Act, Phase
from mavbridge.gate.envelope import EnvelopeLimits
from mavbridge.gate.gate import FlightSettings, Gate, GateInput, GateOutput
from mavbridge.gate.limits import LimitSettings
from mavbridge.gate.smoothing import Smoothing

MS = NS_PER_MS
WANTED = Sticks(0.4, 0.1, -0.2, 0.3)
AGES = FreshnessLimits(
    state_ns=300 * MS, velocity_ns=300 * MS, feature_ns=300 * MS, chunk_ns=300 * MS
)


class Stepped:
    """A gate of 100 Hz at times in ms since its start; attitudes and chunks are 3 ms old."""

    def __init__(
        self,
        *,
        smoothing: Smoothing | None = None,
        meaning: ActionMeaning | None = None,
        status: dict[str, Any] | None = None,
        roles: ModeRoles = COPTER_MODES,
        **rules: Any,
    ) -> None:
        engagement = engagement_settings(
            **({"modes": ("ALT_HOLD",), "departure": DepartureSettings()} | rules)
        )
        settings = FlightSettings(
            meaning=meaning or ActionMeaning(),
            stick_period_ns=10 * MS,
            chunk_period_ns=10 * MS,
            freshness=AGES,
            smoothing=smoothing or stick_smoothing(),
            envelope=EnvelopeLimits(),
            engagement=engagement,
        )
        self.gate = Gate(settings, START_NS)
        self.status = replace(AIRBORNE_STATUS, **(status or {}))
        self.roles = roles
        self.telemetry = Telemetry()
        self.is_released = True
        self.serial = 0
        self.outputs: list[GateOutput] = []

    def chunk(self, at_ms: float, sticks: Action = WANTED, *, actions: int = 16) -> Chunk:
        self.serial += 1
        now_ns = START_NS + round(at_ms * MS)
        stamps = {"attitude_ns": now_ns - 3 * MS, "velocity_ns": now_ns - 3 * MS}
        return Chunk(
            serial=self.serial,
            **stamps,
            image_ns=now_ns - 30 * MS,
            computed_ns=now_ns,
            first_ns=now_ns - 3 * MS,
            step_ns=20 * MS,
            actions=(sticks,) * actions,
        )

    def step(
        self,
        at_ms: float,
        chunk: Chunk | None = None,
        *,
        act: Act | None = None,
        stop: Ending | None = None,
        **changes: Any,
    ) -> GateOutput:
        now_ns = START_NS + round(at_ms * MS)
        self.status = replace(self.status, **({"rc_arrived_ns": now_ns} | changes))
        link = LinkSnapshot(
            telemetry=self.telemetry,
            status=self.status,
            problem=None,
            echo_confirmed=True,
            is_released=self.is_released,
            modes=self.roles,
        )
        output = self.gate.step(now_ns, GateInput(link=link, chunk=chunk, act=act, stop=stop))
        if output.decision is not None:
            self.is_released = isinstance(output.decision, Release)
        self.outputs.append(output)
        return output

    def engaged(self, *, at_ms: float = 30.0, sticks: Sticks = WANTED) -> "Stepped":
        """Three chunks in time, then the operator's key."""
        for k in range(3):
            self.step(at_ms - 30 + 10 * k, self.chunk(at_ms - 30 + 10 * k, sticks))
        self.step(at_ms, self.chunk(at_ms, sticks), act="engage")
        assert self.gate.phase is Phase.FLYING, self.outputs[-1].messages
        return self

    @property
    def decisions(self) -> list[Decision]:
        return [output.decision for output in self.outputs if output.decision is not None]


# --- when


def test_while_nobody_asks_us_to_fly_slots_pass_and_nothing_is_sent() -> None:
    gate = Stepped()
    slots = [gate.step(at_ms, gate.chunk(at_ms)).slot for at_ms in range(0, 100, 5)]
    assert [slot.index for slot in slots if slot is not None] == list(range(10))
    assert gate.decisions == []


def test_a_new_chunk_leaves_at_once_and_a_slot_shortly_after_it_is_left_out() -> None:
    gate = Stepped().engaged()
    early = gate.step(33, gate.chunk(33))
    assert (early.decision, early.slot) == (Command(action=WANTED), None)
    served = gate.step(40)  # 7 ms later
    assert served.slot is not None
    assert served.decision == Command(action=WANTED)
    late = gate.step(46, gate.chunk(46))
    assert (late.decision, late.slot) == (Command(action=WANTED), None)
    left_out = gate.step(50)  # 4 ms later
    assert (left_out.decision, left_out.slot) == (None, None)
    after = gate.step(60)
    assert after.slot is not None
    assert (after.slot.index, after.slot.missed) == (6, 0)


@pytest.mark.parametrize(
    ("changes", "act", "expected"),
    [
        ({"mode": "LOITER"}, None, Release("mode changed from ALT_HOLD to LOITER")),
        ({"armed": False}, None, Release("the vehicle has been disarmed")),
        ({}, "release", Command(action=NEUTRAL)),
    ],
)
def test_a_change_of_hands_does_not_wait_for_a_slot(
    changes: dict[str, Any], act: Act | None, expected: Decision
) -> None:
    gate = Stepped().engaged()
    output = gate.step(31, act=act, **changes)
    assert (output.decision, output.slot) == (expected, None)


def test_what_has_not_changed_is_not_sent_between_slots() -> None:
    gate = Stepped().engaged()
    assert [gate.step(30 + k).decision for k in range(1, 10)] == [None] * 9


def test_a_chunk_that_is_not_taken_is_not_news() -> None:
    gate = Stepped().engaged()
    nan = gate.chunk(33, WANTED._replace(roll=float("nan")))
    assert gate.step(33, nan).decision is None
    assert gate.step(40).decision == Command(action=WANTED)


def test_slots_that_a_stall_has_missed_are_counted_and_not_made_up_for() -> None:
    gate = Stepped().engaged()
    late = gate.step(93, gate.chunk(93))
    assert late.slot is not None
    assert (late.slot.index, late.slot.missed) == (9, 5)
    assert [gate.step(at_ms).decision for at_ms in (94, 95, 96)] == [None] * 3
    on_time = gate.step(100)
    assert on_time.slot is not None
    assert (on_time.slot.index, on_time.slot.missed) == (10, 0)


def test_the_next_step_is_due_at_the_next_slot() -> None:
    gate = Stepped().engaged()
    assert gate.gate.next_ns == START_NS + 40 * MS
    gate.step(36, gate.chunk(36))
    assert gate.gate.next_ns == START_NS + 40 * MS


# --- from where

SLOW = stick_smoothing(max_slew_per_s=1.0, tau_s=0.0)
PILOT = Sticks(0.1, 0.0, -0.3, 0.05)
ECHO = Sticks(0.9, 0.9, 0.9, 0.9)


def first_sticks(gate: Stepped) -> Sticks:
    (first,) = gate.decisions
    assert isinstance(first, Command)
    return first.action


def test_the_policy_starts_from_the_pilots_sticks() -> None:
    gate = Stepped(smoothing=SLOW, status={"pilot_sticks": PILOT, "rc_sticks": ECHO})
    assert first_sticks(gate.engaged()) == PILOT
    moved = gate.step(40).decision
    assert isinstance(moved, Command)
    assert max(abs(a - b) for a, b in zip(moved.action, PILOT, strict=True)) <= 0.0101


def test_without_known_sticks_it_starts_from_neutral_and_never_from_our_own_echo() -> None:
    gate = Stepped(smoothing=SLOW, status={"pilot_sticks": None, "rc_sticks": ECHO})
    assert first_sticks(gate.engaged()) == NEUTRAL


def test_sticks_that_were_seen_long_ago_are_not_known() -> None:
    gate = Stepped(smoothing=SLOW, status={"pilot_sticks": PILOT})
    for k in range(3):
        gate.step(570 + 10 * k, gate.chunk(570 + 10 * k))
    gate.step(601, gate.chunk(601), act="engage", rc_arrived_ns=START_NS + 100 * MS)
    assert first_sticks(gate) == NEUTRAL


def test_after_arming_it_starts_from_idle() -> None:
    gate = Stepped(smoothing=SLOW, arm=True, status={"armed": False, "pilot_sticks": PILOT})
    for k in range(3):
        output = gate.step(10 * k, gate.chunk(10 * k))
    assert output.decision == Command(action=IDLE)
    assert output.arm
    taken = gate.step(30, gate.chunk(30), armed=True)
    assert taken.phase is Phase.FLYING
    assert taken.decision == Command(action=IDLE)


def test_chunks_that_are_refused_do_not_start_the_filter_anew() -> None:
    """Bad ones every other time once made roll creep up by the vehicle's own rounding."""
    gate = Stepped(smoothing=SLOW, status={"pilot_sticks": NEUTRAL, "rc_sticks": ECHO})
    gate.engaged(sticks=NEUTRAL)
    for k in range(8):
        at_ms = 40 + 10 * k
        sticks = NEUTRAL if k % 2 else NEUTRAL._replace(roll=float("nan"))
        gate.step(at_ms, gate.chunk(at_ms, sticks), rc_sticks=ECHO)
    assert gate.gate.phase is Phase.FLYING
    assert set(gate.decisions) == {Command(action=NEUTRAL)}


# --- which


def test_the_trace_shows_what_became_of_the_action() -> None:
    output = Stepped().engaged(sticks=Sticks(1.5, 0.0, 0.0, 0.0)).outputs[-1]
    assert output.trace is not None
    assert (output.trace.raw.throttle, output.trace.clipped.throttle) == (1.5, 1.0)
    assert output.decision == Command(action=output.trace.smoothed)
    assert output.chunk_serial == 4


def test_beyond_the_horizon_neutral_bridges_the_rest_of_the_grace() -> None:
    gate = Stepped().engaged()
    gate.step(33, gate.chunk(33, actions=2))  # acts until 70
    sent = {at_ms: gate.step(at_ms) for at_ms in range(40, 150, 10)}
    assert {at_ms for at_ms, out in sent.items() if out.decision == Command(action=WANTED)} == {
        *(40, 50, 60, 70)
    }
    flown = [at_ms for at_ms, out in sent.items() if out.phase is Phase.FLYING]
    assert flown == list(range(40, 140, 10))
    assert all(sent[at_ms].decision == Command(action=NEUTRAL) for at_ms in range(80, 150, 10))
    assert sent[140].phase is Phase.LEAVING
    assert sent[140].trace is None
    assert sent[140].chunk_serial is None


def test_coasting_is_told() -> None:
    gate = Stepped().engaged()
    told = {at_ms: gate.step(at_ms).is_coasting for at_ms in range(40, 100, 10)}
    assert told == {40: False, 50: False, 60: True, 70: True, 80: True, 90: True}
    assert not gate.step(95, gate.chunk(95)).is_coasting


def test_where_the_throttle_is_thrust_it_stays_until_the_safe_mode_is_there() -> None:
    gate = Stepped(modes=("STABILIZE",), status={"mode": "STABILIZE", "has_receiver": False})
    gate.engaged()
    left = gate.step(31, act="release")
    assert left.decision == Command(action=NEUTRAL._replace(throttle=WANTED.throttle))
    assert left.mode == "LAND"
    assert gate.step(40).decision == left.decision
    assert gate.step(50, mode="LAND").decision == Command(action=NEUTRAL)


def test_read_only_flies_as_if_it_sent() -> None:
    gate = Stepped(readonly=True)
    outputs = [gate.step(10 * k, gate.chunk(10 * k), mode="ALT_HOLD") for k in range(4)]
    assert [out.phase for out in outputs] == [Phase.WAITING] * 2 + [Phase.FLYING] * 2
    assert outputs[-1].trace is not None
    assert outputs[-1].decision == Command(action=WANTED)  # which a read-only link does not send


def test_a_landing_counts_from_the_beginning_of_each_flight() -> None:
    gate = Stepped().engaged()
    gate.step(40, gate.chunk(40))  # in the air
    for at_ms in range(50, 800, 10):
        gate.step(at_ms, gate.chunk(at_ms), is_landed=True)
    assert gate.outputs[-1].phase is Phase.RELEASED
    assert gate.outputs[-1].reason == "the vehicle has landed"
    gate.engaged(at_ms=830)  # still armed, on the ground
    for at_ms in range(840, 1600, 10):
        gate.step(at_ms, gate.chunk(at_ms))
    assert gate.outputs[-1].phase is Phase.FLYING


# --- words


def test_what_is_not_watched_is_told_once_at_the_beginning() -> None:
    gate = Stepped(status={"position_ned_m": None}).engaged()
    gate.step(40, gate.chunk(40))
    told = [text for output in gate.outputs for text in output.messages]
    assert sum(text.startswith("height is not watched") for text in told) == 1


def test_the_reason_why_an_act_had_no_effect_is_told_once() -> None:
    gate = Stepped(status={"armed": False})
    (told,) = gate.step(0, gate.chunk(0), act="engage").messages
    assert "disarmed" in told
    assert gate.step(10).messages == ()


def test_absence_is_the_reason_for_not_flying() -> None:
    gate = Stepped()
    link = LinkSnapshot(telemetry=Telemetry(), status=gate.status, problem=None)
    output = gate.gate.step(START_NS, GateInput(link=link, absence="no image feature yet"))
    assert output.reason == "no image feature yet"


def test_without_a_vehicle_it_waits_and_can_be_ended() -> None:
    gate = Stepped().gate
    link = LinkSnapshot(telemetry=Telemetry(), status=None, problem="waiting for a heartbeat")
    waiting = gate.step(START_NS, GateInput(link=link, act="engage"))
    assert (waiting.phase, waiting.decision) == (Phase.WAITING, None)
    assert waiting.reason == "waiting for a heartbeat"
    ended = gate.step(START_NS + MS, GateInput(link=link, stop=Ending(reason="enough")))
    assert (ended.phase, ended.decision) == (Phase.ENDED, None)
    assert gate.failure is None


def test_body_rates_are_bridged_by_a_level_attitude() -> None:
    turn = BodyRates(0.5, 1.0, 0.0, 0.0)
    rates = Smoothing(limits=LimitSettings().of("rates"), tau_s=0.0)
    gate = Stepped(meaning=ActionMeaning(kind="rates", hover_thrust=0.4), smoothing=rates)
    for k in range(3):
        gate.step(10 * k, gate.chunk(10 * k, turn))
    engaged = gate.step(30, gate.chunk(30, turn, actions=1), act="engage")
    assert engaged.decision == Command(action=turn)
    beyond = gate.step(50)
    assert beyond.decision == Command(action=AttitudeThrust(0.4, 0.0, 0.0, 0.0))
    assert beyond.trace is not None
    assert gate.step(60, gate.chunk(60, turn)).decision == Command(action=turn)


def test_a_chunk_of_another_kind_of_action_is_not_flown() -> None:
    gate = Stepped().engaged()
    gate.step(40, gate.chunk(40, BodyRates(0.5, 1.0, 0.0, 0.0)))
    assert gate.step(50).decision == Command(action=WANTED)
    for k in range(6, 12):
        gate.step(10 * k, gate.chunk(10 * k, BodyRates(0.5, 1.0, 0.0, 0.0)))
    assert gate.gate.phase is Phase.LEAVING
    assert "unusable chunks" in gate.outputs[-1].reason


def test_neutral_velocities_on_the_way_in_are_not_those_of_an_earlier_flight() -> None:
    limits = LimitSettings(accel_mps2=5.0).of("velocity")
    gate = Stepped(
        meaning=ActionMeaning(kind="velocity"),
        smoothing=Smoothing(limits=limits, tau_s=0.0),
        status={"mode": "OFFBOARD"},
        roles=PX4_MODES,
        modes=("OFFBOARD",),
        is_setpoint=True,
        departure=DepartureSettings(is_setpoint=True),
    )
    fast = Velocity(3.0, 0.0, 0.0, 0.0)
    gate.engaged(sticks=fast)
    for at_ms in range(40, 1000, 10):
        gate.step(at_ms, gate.chunk(at_ms, fast))
    assert gate.decisions[-1] == Command(action=fast)
    gate.step(1000, gate.chunk(1000, fast), mode="ALTCTL")
    gate.is_released = True
    gate.step(1010, gate.chunk(1010, fast))
    entering = gate.step(1020, gate.chunk(1020, fast), act="engage")
    assert gate.gate.phase is Phase.PREPARING
    assert entering.decision == Command(action=Velocity(0.0, 0.0, 0.0, 0.0))


def test_a_flight_by_velocities_begins_within_their_limits_whatever_the_vehicle_says() -> None:
    """One wrong reading would be asked for, and 20 s later still for most of it."""
    limits = LimitSettings(speed_mps=8.0, climb_mps=3.0, accel_mps2=5.0).of("velocity")
    gate = Stepped(
        meaning=ActionMeaning(kind="velocity"), smoothing=Smoothing(limits=limits, tau_s=0.0)
    )
    gate.telemetry = Telemetry(velocity_ned_mps=Reading(START_NS, (3.4e38, 0.0, -90.0)))
    gate.engaged(sticks=Velocity(0.0, 0.0, 0.0, 0.0))
    first = gate.decisions[0]
    assert isinstance(first, Command)
    assert isinstance(first.action, Velocity)
    assert math.hypot(first.action.x_mps, first.action.y_mps) <= 8.0
    assert abs(first.action.z_mps) <= 3.0
