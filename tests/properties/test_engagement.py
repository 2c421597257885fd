"""Random facts and acts: what the state machine of the engagement never does."""

from dataclasses import replace
from typing import Any

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
)

from helpers.guard_facts import AIRBORNE, COPTER_MODES, STEP_NS, Stepped
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.vehicle import NEUTRAL
from mavbridge.guard.sequences import MODE_TIMEOUT_NS, NEUTRAL_NS, DisengageSettings
from mavbridge.guard.table import RELEASE_TIMEOUT_NS
from mavbridge.guard.values import Actions, ControlSource, EndRequest, OperatorCommand, Phase

MODES = ("ALT_HOLD", "LOITER")
JOYSTICK = because(Code.OVERRULED, quantity="sticks", cause="a joystick")
PROBLEMS = (
    *("link_problem", "chunk_problem", "chunk_fault", "envelope_problem", "landing"),
    *("overruled", "refused_mode"),
)
ENDINGS = st.sampled_from(("auto", "release", "hold", "land", "rtl"))
HOLDS_STICKS = (Phase.FLYING, Phase.LEAVING, Phase.HOLDING)
BOUND_NS = MODE_TIMEOUT_NS + NEUTRAL_NS + RELEASE_TIMEOUT_NS + 10 * STEP_NS
"""From a stop to the end where nothing forbids to release: safe mode, neutral, release."""


class EngagementMachine(RuleBasedStateMachine):
    """A vehicle that may do anything, an operator who may press any key at any time."""

    @initialize(
        on_fault=ENDINGS,
        then=ENDINGS,
        has_receiver=st.booleans(),
        engage_channel=st.sampled_from((None, 7)),
        mode=st.sampled_from((None, *MODES)),
    )
    def begin(self, *, has_receiver: bool, **chosen: Any) -> None:
        departure = DisengageSettings(on_fault=chosen["on_fault"], then=chosen["then"])
        facts = replace(
            AIRBORNE,
            has_receiver=has_receiver,
            pilot_sticks=NEUTRAL if has_receiver else None,
            mode=chosen["mode"] or "ALT_HOLD",
        )
        self.vehicle = Stepped(
            facts,
            modes=MODES,
            disengage=departure,
            mode=chosen["mode"],
            engage_channel=chosen["engage_channel"],
        )
        self.switch_is_low = False
        """The switch was low, and has not been high since."""
        self.has_act = False
        """An explicit act has come since the sticks were last lost."""
        self.was_taken = False
        """Somebody has taken the sticks, and no act has come since."""
        self.stopped_ns: int | None = None
        self.last = Actions()
        self.good = facts
        self.step()
        self.press("engage")
        assert self.vehicle.phase is Phase.FLYING

    def step(self, act: OperatorCommand | None = None, **changes: Any) -> Actions:
        """One step; notes acts and losses as an observer of the facts would."""
        before, facts = self.vehicle.phase, self.vehicle.facts
        switch_us = changes.get("rc_channels_us", facts.rc_channels_us)[6]
        if act == "engage" or (switch_us > 1800 and self.switch_is_low):
            self.has_act = True
        if not 1200 <= switch_us <= 1800:  # a switch of three positions passes through the middle
            self.switch_is_low = switch_us < 1200
        is_mode = changes.get("mode", facts.mode)
        own, asked = self.vehicle.engagement.own_mode, self.vehicle.engagement.disengage.mode
        if before is Phase.FLYING:
            own, asked = facts.mode, None
        takes = before in HOLDS_STICKS and (
            changes.get("armed") is False
            or changes.get("is_switched_off") is True
            or changes.get("overruled") is not None
            or changes.get("interruptions", facts.interruptions) != facts.interruptions
            or (own is not None and is_mode not in (own, asked))
        )
        self.last = self.vehicle.step(act, **changes)
        after = self.vehicle.phase
        if takes:
            self.was_taken = True
            assert self.last == Actions(control=ControlSource.RELEASE), (
                "in this same step, and no mode"
            )
            assert after is Phase.RELEASING
        if before is Phase.FLYING and after is not Phase.FLYING:
            self.has_act = False
        return self.last

    # --- the operator

    @rule(act=st.sampled_from(("engage", "release")))
    def press(self, act: OperatorCommand) -> None:
        if act == "engage" and self.vehicle.phase in (Phase.WAITING, Phase.RELEASED):
            self.was_taken = False
        self.step(act)

    @rule(us=st.sampled_from((1000, 1500, 2000)))
    def turn_switch(self, us: int) -> None:
        channels = (*self.vehicle.facts.rc_channels_us[:6], us, 1500)
        if self.vehicle.phase in (Phase.WAITING, Phase.RELEASED):
            self.was_taken = False
        self.step(rc_channels_us=channels)

    @rule(mode=st.sampled_from(MODES))
    def engage_again(self, mode: str) -> None:
        """The pilot brings everything in order first, and waits."""
        for _ in range(120):
            self.step(
                armed=True,
                mode=mode,
                is_switched_off=False,
                rc_channels_us=self.good.rc_channels_us,
                **dict.fromkeys(PROBLEMS),
            )
            self.holds()
        self.press("engage")
        if self.vehicle.engagement.settings.engage_channel is None and self.stopped_ns is None:
            assert self.vehicle.phase not in (Phase.WAITING, Phase.RELEASED), "it can be flown"

    @rule(is_fault=st.booleans())
    @precondition(lambda self: len(self.vehicle.moves) > 300)
    def stop(self, is_fault: bool) -> None:
        self.vehicle.engagement.stop(EndRequest(reason=because(Code.SIGNAL), is_fault=is_fault))
        if self.stopped_ns is None:
            self.stopped_ns = self.vehicle.facts.now_ns
        self.step()

    # --- the vehicle and the inputs

    @rule(mode=st.sampled_from(COPTER_MODES.names))
    def change_mode(self, mode: str) -> None:
        self.step(mode=mode)

    @rule()
    @precondition(lambda self: self.last.mode is not None)
    def obey(self) -> None:
        self.step(mode=self.last.mode)

    @rule()
    @precondition(lambda self: self.last.mode is not None)
    def refuse(self) -> None:
        self.step(refused_mode=self.last.mode)

    @rule(armed=st.booleans())
    def arm(self, armed: bool) -> None:
        self.step(armed=armed)

    @rule(
        name=st.sampled_from(("link_problem", "chunk_fault", "envelope_problem", "landing")),
        is_bad=st.booleans(),
        mode=st.sampled_from((None, None, "RTL")),
    )
    def change_input(self, name: str, is_bad: bool, mode: str | None) -> None:
        """Also in the same step as a change of mode."""
        changes: dict[str, Any] = {name: because(Code.NO_CHUNK) if is_bad else None}
        if name == "chunk_fault":
            changes["chunk_problem"] = changes[name]
        if mode is not None:
            changes["mode"] = mode
        self.step(**changes)

    @rule(is_off=st.booleans())
    def switch_overrides(self, is_off: bool) -> None:
        self.step(is_switched_off=is_off)

    @rule(overruled=st.sampled_from((None, JOYSTICK)))
    def overrule(self, overruled: Reason | None) -> None:
        self.step(overruled=overruled)

    @rule()
    def reboot(self) -> None:
        self.step(
            interruption=because(Code.REBOOTED),
            interruptions=self.vehicle.facts.interruptions + 1,
            armed=False,
            mode="STABILIZE",
            link_problem=because(Code.READING_PARAMETERS),
        )

    @rule(is_released=st.booleans(), echo_confirmed=st.booleans(), is_position_valid=st.booleans())
    def change_rest(self, **changes: bool) -> None:
        self.step(**changes)

    @rule(seconds=st.sampled_from((0.05, 0.5, 1.2, 4.0)))
    def wait(self, seconds: float) -> None:
        for _ in range(round(seconds * NS_PER_S / STEP_NS)):
            self.step()
            self.holds()

    # --- what always holds

    @invariant()
    def holds(self) -> None:
        if not hasattr(self, "vehicle"):
            return
        vehicle, move = self.vehicle, self.last
        if move.control is ControlSource.POLICY:
            assert self.has_act, "the policy flies, and nobody has asked for it"
            assert vehicle.phase is Phase.FLYING
            assert vehicle.facts.armed
        if self.was_taken:
            assert move.mode is None, "a mode is asked for after a takeover"
            assert not move.arm
            assert move.control in (ControlSource.RELEASE, None)
        if vehicle.phase in (Phase.WAITING, Phase.RELEASED, Phase.ENDED):
            assert move == Actions() or move.control is None
        if move.arm:
            assert vehicle.phase is Phase.PREPARING
            assert not vehicle.facts.armed
        self._ends_in_time()

    def _ends_in_time(self) -> None:
        facts = self.vehicle.facts
        if self.stopped_ns is None or self.vehicle.phase is Phase.ENDED:
            return
        if facts.armed and not facts.has_receiver:
            self.stopped_ns = facts.now_ns  # neutral is held until it is disarmed
        assert facts.now_ns - self.stopped_ns <= BOUND_NS, self.vehicle.phase


EngagementMachine.TestCase.settings = settings(
    max_examples=100, stateful_step_count=40, deadline=None, derandomize=True
)
TestEngagement = EngagementMachine.TestCase
