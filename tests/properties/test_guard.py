"""Arbitrary events against a guard: what it never decides."""

import math
import os
from typing import Any

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule

from helpers.guard_machine import FLIGHT_MODES, GRACE_NS, LIMIT_NS, MS, STEP_NS, GuardWorld, Shown
from mavbridge.core.reasons import Code, because
from mavbridge.core.switch import DWELL_NS
from mavbridge.core.vehicle import Sticks
from mavbridge.guard.table import UNSEEN_NS
from mavbridge.guard.values import EndRequest, OperatorCommand, Phase

ENDINGS = st.sampled_from(("auto", "release", "hold", "land", "rtl"))
AT_REST = (Phase.WAITING, Phase.RELEASED, Phase.ENDED)
OTHER_MODES = ("LOITER", "LAND", "STABILIZE", "BRAKE", "AUTO.LOITER", "AUTO.LAND", "MANUAL")
BOUND_NS = 9_000 * MS
"""From a stop until the end where nothing forbids to release: the safe mode, neutral, release."""
RELEASE_NS = 3 * STEP_NS
"""Between releases, and from the end of the sticks until the first."""


class GuardMachine(RuleBasedStateMachine):
    """A vehicle, a pilot, a link and a flight process that may do anything at any time."""

    @initialize(
        combination=st.sampled_from(tuple(FLIGHT_MODES)),
        has_receiver=st.booleans(),
        on_fault=ENDINGS,
        then=ENDINGS,
        engage_channel=st.sampled_from((None, None, 7)),
    )
    def begin(self, combination: tuple[str, str], **chosen: Any) -> None:
        self.world = GuardWorld(*combination, **chosen)
        self.has_act = False
        """An explicit act has come that no flight has used up."""
        self.must_end = False
        """What ends a flight at once has happened since the last step."""
        self.was_stopped_ns: int | None = None
        self.silent_ns: int | None = None
        """Since when no chunk comes."""
        self.switch_is_low = False
        self.switched_ns: int | None = None
        """When the engage switch last went from low to high."""
        self.released_ns: int | None = None
        self.advance(60)
        if chosen["engage_channel"]:
            self.turn_switch(1000)
            self.advance(300)
            self.turn_switch(2000)
            self.advance(300)
        else:
            self.act("engage")
        assert self.world.phase in (Phase.FLYING, Phase.PREPARING), (
            self.world.guard.engagement.refusal
        )
        self.advance(300)
        assert self.world.phase is Phase.FLYING

    # --- one wake of the guard, and what must hold after it

    def step(self) -> None:
        world = self.world
        world.clock.advance_ns(MS)
        before = world.phase
        must_end = self.must_end and before is Phase.FLYING
        is_switched = self.switched_ns is not None and (
            world.now_ns - self.switched_ns <= DWELL_NS + 3 * STEP_NS
        )
        had_act = self.has_act or is_switched
        shown = world.step()
        self._judge_phases(before, had_act, must_end)
        if shown is not None:
            self._judge(shown)
        if before is Phase.FLYING and world.phase is not Phase.FLYING:
            self._judge_end(shown)
        self._judge_release(shown)
        self._judge_patience()
        self.must_end = False

    def _judge_phases(self, before: Phase, had_act: bool, must_end: bool) -> None:
        phase = self.world.phase
        if before in AT_REST and phase not in AT_REST:
            assert had_act, f"{before} -> {phase} without an act"
        if before is not Phase.PREPARING and phase is Phase.FLYING and before is not phase:
            assert had_act
        if phase is not Phase.PREPARING:
            self.has_act = False  # it was followed, or refused and forgotten
        assert not (must_end and phase is Phase.FLYING), "the flight goes on"

    def _judge(self, shown: Shown) -> None:
        world = self.world
        if shown.phase in AT_REST:
            raise AssertionError(f"{shown.kind} in {shown.phase}")
        assert (shown.kind == "release") is (shown.phase is Phase.RELEASING)
        if shown.kind != "policy":
            return
        assert shown.phase is Phase.FLYING, f"the policy's sticks in {shown.phase}"
        assert world.vehicle.armed
        assert shown.code in world.chunks, "sticks of no chunk that may be flown"
        chunk, at_ns = world.chunks[shown.code], shown.at_ns
        assert at_ns - chunk.attitude_ns <= LIMIT_NS + GRACE_NS + STEP_NS
        assert at_ns - chunk.velocity_ns <= LIMIT_NS + GRACE_NS + STEP_NS
        assert at_ns - chunk.image_ns <= 2 * LIMIT_NS + GRACE_NS + STEP_NS
        assert at_ns - chunk.computed_ns <= GRACE_NS + STEP_NS, "beyond the grace"
        assert all(math.isfinite(value) for action in chunk.actions for value in action)

    def _judge_end(self, shown: Shown | None) -> None:
        """Neutral or a release in the step that ends a flight."""
        is_left = self.world.phase is Phase.LEAVING
        assert shown is not None
        assert shown.kind == ("neutral" if is_left else "release"), shown

    def _judge_release(self, shown: Shown | None) -> None:
        """It is released in each slot for as long as it is not over."""
        now_ns = self.world.now_ns
        if self.world.phase is not Phase.RELEASING:
            self.released_ns = None
            return
        if shown is not None:
            self.released_ns = now_ns
        assert self.released_ns is not None, "no release in the first step"
        assert now_ns - self.released_ns <= RELEASE_NS, "releases have stopped"

    def _judge_patience(self) -> None:
        """What takes some time to notice, and the end of everything."""
        world, now_ns = self.world, self.world.now_ns
        if world.phase is Phase.FLYING:
            bounds = [(self.silent_ns, GRACE_NS + 2 * STEP_NS)]
            if world.engage_channel is not None:
                bounds.append((world.vehicle.radio_ns, UNSEEN_NS + 2 * STEP_NS))
            for since_ns, bound_ns in bounds:
                assert since_ns is None or now_ns - since_ns <= bound_ns, "not noticed"
        if self.was_stopped_ns is not None and world.phase is not Phase.ENDED:
            if world.vehicle.armed and world.phase is Phase.HOLDING:
                self.was_stopped_ns = now_ns  # until it is disarmed
            assert now_ns - self.was_stopped_ns <= BOUND_NS, f"{world.phase} does not end"

    def advance(self, ms: int) -> None:
        for _ in range(0, ms, 10):
            self.world.clock.advance_ns(STEP_NS - MS)
            self.step()

    # --- the operator, the pilot, and whoever else holds sticks

    @rule(what=st.sampled_from(("engage", "engage", "release")))
    def act(self, what: OperatorCommand) -> None:
        self.world.act = what
        channel, is_low = self.world.engage_channel, self.switch_is_low
        self.has_act = what == "engage"
        self.must_end = what == "release"
        if channel is not None and is_low:
            self.has_act = False
        self.step()

    @precondition(lambda self: self.world.engage_channel and not self.world.vehicle.radio_ns)
    @rule(us=st.sampled_from((1000, 1500, 2000)))
    def turn_switch(self, us: int) -> None:
        self.world.vehicle.switch_us = us
        is_act = us == 2000 and self.switch_is_low
        self.switched_ns = self.world.now_ns if is_act else None
        self.must_end = us == 1000
        if us != 1500:
            self.switch_is_low = us == 1000
        self.step()

    @rule(is_lost=st.booleans())
    def lose_radio(self, is_lost: bool) -> None:
        """RC_CHANNELS stops or comes again."""
        now_ns = self.world.vehicle.radio_ns or self.world.now_ns
        self.world.vehicle.radio_ns = now_ns if is_lost else None
        self.step()

    @rule(is_off=st.booleans())
    def switch_overrides(self, is_off: bool) -> None:
        self.world.is_switched_off = is_off
        self.must_end = is_off and self.world.kind == "sticks"
        self.step()

    @rule(is_overruled=st.booleans())
    def overrule(self, is_overruled: bool) -> None:
        """The vehicle shows another source's sticks, or ours again."""
        reason = because(Code.OVERRULED, quantity="sticks", output="rc-override", fault="foreign")
        self.world.overruled = reason if is_overruled else None
        self.must_end = is_overruled
        self.step()

    # --- the vehicle and the link

    @rule(mode=st.sampled_from(OTHER_MODES))
    def change_mode(self, mode: str) -> None:
        self.world.vehicle.mode = mode
        self.must_end = True
        self.step()

    @rule()
    def return_to_mode(self) -> None:
        self.world.vehicle.mode = self.world.mode
        self.step()

    @rule()
    def obey(self) -> None:
        if (asked := self.world.outputs[-1].actions.mode) is not None:
            self.world.vehicle.mode = asked
        self.step()

    @rule(is_refusing=st.booleans())
    def answer(self, is_refusing: bool) -> None:
        self.world.refused_mode = self.world.outputs[-1].actions.mode if is_refusing else None
        self.step()

    @rule(armed=st.booleans())
    def arm(self, armed: bool) -> None:
        self.world.vehicle.armed = armed
        self.must_end = not armed
        self.step()

    @rule(is_failsafe=st.booleans())
    def fail_safe(self, is_failsafe: bool) -> None:
        was_flying = self.world.phase is Phase.FLYING
        self.world.vehicle.is_failsafe = is_failsafe
        self.must_end = is_failsafe
        self.step()
        reason = self.world.guard.engagement.reason
        is_px4, is_kept = self.world.autopilot == "px4", self.world.vehicle.mode == self.world.mode
        if was_flying and not is_px4 and is_kept and reason and reason.codes == (Code.FAILSAFE,):
            assert self.world.phase is Phase.LEAVING, "nobody flies a vehicle that keeps the mode"

    @rule()
    def reboot(self) -> None:
        self.world.interruption = because(Code.REBOOTED)
        self.world.interruptions += 1
        self.must_end = True
        self.step()

    @rule(is_lost=st.booleans())
    def lose_link(self, is_lost: bool) -> None:
        self.world.link_problem = because(Code.HEARTBEAT_LOST) if is_lost else None
        self.must_end = is_lost
        self.step()

    # --- the flight process

    @rule(has_chunks=st.booleans())
    def hang(self, has_chunks: bool) -> None:
        if self.was_stopped_ns is None:
            self.world.has_chunks = has_chunks
            self.silent_ns = None if has_chunks else (self.silent_ns or self.world.now_ns)
        self.step()

    @rule(
        kind=st.sampled_from(
            ("nan", "inf", "empty", "other", "old state", "old image", "old", "future", "again")
        ),
        times=st.sampled_from((1, 3, 6)),
    )
    def send_odd_chunks(self, kind: str, times: int) -> None:
        for _ in range(times):
            self.world.clock.advance_ns(STEP_NS - MS)
            self.world.odd_chunk = self._odd_chunk(kind)
            self.step()
        if times >= 5 and kind in ("nan", "inf", "empty", "other"):
            assert self.world.phase is not Phase.FLYING, "malformed chunks go on"

    def _odd_chunk(self, kind: str) -> Any:
        world, now_ns = self.world, self.world.now_ns
        bad = math.nan if kind == "nan" else math.inf
        old = world.serial
        match kind:
            case "nan" | "inf":
                made = world.chunk(actions=(Sticks(0.0, bad, 0.4, 0.0),) * 4)
            case "empty":
                made = world.chunk(actions=())
            case "other":
                made = world.chunk()
                made = made._replace(actions=((0.0, 0.0, 0.4, 0.0),) * 4)
            case "old state":
                made = world.chunk(attitude_ns=now_ns - LIMIT_NS - MS)
            case "old image":
                made = world.chunk(image_ns=now_ns - 2 * LIMIT_NS - MS)
            case "old":
                made = world.chunk(computed_ns=now_ns - LIMIT_NS - MS)
            case "future":
                return world.chunk(computed_ns=now_ns, first_ns=now_ns + 500 * MS)
            case _:
                return world.chunk()._replace(serial=old)  # doubled: it is not flown
        del world.chunks[made.serial % 200]
        return made

    @precondition(lambda self: self.was_stopped_ns is None)
    @rule(how=st.sampled_from(("dies", "dies", "ends", "fails")))
    def end(self, how: str) -> None:
        code = {"dies": Code.FLIGHT_PROCESS_DIED, "ends": Code.SIGNAL, "fails": Code.POLICY_FAILED}[
            how
        ]
        self.world.stop = EndRequest(because(code), "signal" if how == "ends" else "fault")
        if how == "dies":
            self.world.has_chunks = False
            self.silent_ns = self.silent_ns or self.world.now_ns
        self.was_stopped_ns = self.world.now_ns
        self.must_end = True
        self.step()

    # --- time

    @rule(ms=st.sampled_from((10, 30, 100, 400, 1200, 3500)))
    def wait(self, ms: int) -> None:
        self.advance(ms)

    @rule(ms=st.sampled_from((20, 90, 250, 900)))
    def stall(self, ms: int) -> None:
        """The guard does not run, and finds all that has happened at its next wake."""
        self.world.clock.advance_ns(ms * MS)
        for name in ("was_stopped_ns", "released_ns"):
            if (since_ns := getattr(self, name)) is not None:
                setattr(self, name, since_ns + ms * MS)
        self.step()

    @rule(ms=st.sampled_from((400, 2000)))
    def mend(self, ms: int) -> None:
        """Everything is in order again, and still nothing flies by itself."""
        world = self.world
        world.vehicle.mode, world.vehicle.armed = world.mode, True
        world.vehicle.is_failsafe = world.is_switched_off = False
        world.link_problem = world.overruled = world.refused_mode = None
        world.vehicle.radio_ns = None
        if self.was_stopped_ns is None:
            world.has_chunks, self.silent_ns = True, None
        self.must_end = False
        self.step()
        self.advance(ms)

    @rule()
    def engage_again(self) -> None:
        """After a flight that has ended, an act flies again: nothing that has happened lasts."""
        self.mend(400)
        if self.world.phase in (Phase.LEAVING, Phase.HOLDING):
            self.arm(False)
        for _ in range(90):
            if self.world.phase in AT_REST:
                break
            self.advance(100)
        self.mend(1100)
        if self.was_stopped_ns is None and self.world.phase is not Phase.FLYING:
            if self.world.engage_channel is not None:
                self.turn_switch(1000)
                self.advance(2000)
                self.turn_switch(2000)
                self.advance(200)
            else:
                self.act("engage")
            self.advance(150)
            assert self.world.phase is Phase.FLYING, self.world.outputs[-1]


EXAMPLES = int(os.environ.get("GUARD_EXAMPLES", "50"))
"""Always the same 50; with another number, as in `make fuzz`, others each time."""
GuardMachine.TestCase.settings = settings(
    max_examples=EXAMPLES,
    stateful_step_count=30,
    deadline=None,
    derandomize="GUARD_EXAMPLES" not in os.environ,
    database=None,
    suppress_health_check=list(HealthCheck),
)
TestGuard = GuardMachine.TestCase
