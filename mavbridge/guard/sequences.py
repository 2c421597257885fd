"""The two multi-step sequences of the engagement: into a flight, and out of it."""

from dataclasses import dataclass

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.switch import GAP_NS
from mavbridge.core.vehicle import OnFault
from mavbridge.guard.values import (
    ControlSource,
    EngagementInputs,
    EngagementOutput,
    EngagementSettings,
)

REQUEST_SPACING_NS = NS_PER_S
"""Time between requests to arm or change the mode: each refusal prints the vehicle's reason."""
ARRIVED = 0.9
"""Fraction of the takeoff height at which the policy's mode is requested."""
FLOW_NS = 100 * NS_PER_MS
"""Time for which setpoints flow before a mode that needs them is requested. PX4 accepted OFFBOARD
20 ms after the first setpoint, and refused it when requested together with it."""
NEUTRAL_NS = 50 * NS_PER_MS
"""Least time of neutral sticks before the release."""
MODE_SPACING_NS = 100 * NS_PER_MS
"""Time between two requests for the safe mode; ArduPilot answers within 10 ms."""
SLOW_SPACING_NS = NS_PER_S
"""Time between requests for a mode not confirmed within MODE_TIMEOUT_NS over a good link."""
MODE_TIMEOUT_NS = 3 * NS_PER_S
"""Longest wait for the safe mode while the vehicle is heard; HEARTBEAT, which confirms it, may come
at 1 Hz."""
BLIND_NS = 3 * NS_PER_S
"""Longest time to request a mode from a vehicle that is not heard, if its receiver takes over when
our sticks end: the failsafe for a lost ground station comes after 5 s."""
FAILSAFE_BLIND_NS = 500 * NS_PER_MS
"""Longest time to request a mode from a vehicle that is not heard, if its failsafe follows and must
not be undone: after 0.5 s (COM_RC_LOSS_T) or 1 s (RC_FS_TIMEOUT, COM_OF_LOSS_T)."""
SETPOINT_NS = 500 * NS_PER_MS
"""Longest stream of neutral setpoints while waiting for the mode on PX4. A vehicle that has not
answered by then does not hear us. It would return to OFFBOARD within 30 ms of hearing a setpoint
after its failsafe (COM_OF_LOSS_T, 1 s)."""
STICK_REST_NS = NS_PER_S
"""Longest wait for our sticks to come to rest before the safe mode is requested anyway: PX4 looks
at them in turn, and takes 0.28 s for each that has jumped by half its range."""
UNDONE_NS = NS_PER_S
"""Time in a safe mode within which PX4 may leave it because of our jump to neutral, and time since
it did not get our sticks: then they jump to those of a receiver at rest, and back."""
WORD_NS = 100 * NS_PER_MS
"""Wait for the EVENT that reports moved sticks; another station's mode change causes none."""
MIDDLE_STICK = 0.2
"""Largest distance of a receiver's throttle from the middle that roughly holds height (ArduPilot's
THR_DZ is 0.2 of the stick's travel to each side)."""


@dataclass(slots=True)
class EngageSequence:
    """Mode, arming, takeoff: ``begin`` starts, ``step`` continues until nothing is missing."""

    settings: EngagementSettings
    waits_for: Reason | None = None
    """Missing condition; None: ready to fly."""
    arms: bool = False
    """True if the vehicle was disarmed at the beginning: we keep it idle, and arm it."""
    asked_mode: str | None = None
    request_due_ns: int = 0
    is_up: bool = False
    """True if no takeoff is wanted, or its height has been reached."""
    ground_m: float | None = None
    flows_from_ns: int | None = None
    """Start of the stream of setpoints or sticks that a mode needs before it is entered."""
    lends_sticks: bool = False
    """True if a vehicle in the air without sticks has refused the mode: neutral sticks flow."""

    def begin(self, now: EngagementInputs) -> None:
        """Start from the vehicle's present state."""
        self.arms = not now.status.armed
        self.is_up = self.settings.takeoff_m is None or not self.arms
        self.asked_mode = self.ground_m = self.flows_from_ns = None
        self.lends_sticks = False

    @property
    def has_sticks(self) -> bool:
        """True if the vehicle gets our sticks during the sequence."""
        return self.arms or self.lends_sticks

    def is_own_mode(self, now: EngagementInputs) -> bool:
        """True if the present mode was requested, or belongs to the autopilot's takeoff."""
        has_takeoff = self.settings.takeoff_m is not None and self.arms
        return now.status.mode == self.asked_mode or (
            has_takeoff and now.status.mode in now.link.modes.takeoff
        )

    def may_change_mode(self, now: EngagementInputs) -> bool:
        """True if an act requests another mode: the flag's, or one entered only by setpoints."""
        if self.settings.mode is not None:
            return now.status.mode != self.settings.mode
        needs_flow = self.settings.is_setpoint and now.link.modes.needs_setpoints_first
        return needs_flow and now.status.mode not in self.settings.modes

    def wanted_mode(self, now: EngagementInputs) -> str | None:
        """Return the mode to request, or None if the present one is right."""
        wanted = self.settings.mode
        if not self.is_up:
            wanted = (
                now.status.mode if now.status.armed else next(iter(now.link.modes.takeoff), None)
            )
        elif wanted is None and now.status.mode not in self.settings.modes:
            known = [mode for mode in self.settings.modes if mode in now.link.modes.names]
            wanted = known[0] if known else self.settings.modes[0]
        return None if wanted == now.status.mode else wanted

    def impossibility(self, now: EngagementInputs) -> Reason | None:
        """Return why waiting will not help, or None."""
        names, wanted = now.link.modes.names, self.wanted_mode(now)
        if wanted is None or not names or wanted in names:
            return now.command_fault or now.slowness
        return because(Code.NO_SUCH_MODE, mode=wanted, modes=", ".join(names))

    def step(self, now: EngagementInputs, objection: Reason | None) -> EngagementOutput:
        """Advance; with an ``objection``, keep the sticks going but request nothing."""
        self._watch_climb(now)
        wanted = self.wanted_mode(now)
        climb_m = self.settings.takeoff_m if not self.is_up and now.status.armed else None
        self._lend_sticks(now, wanted)
        control = self._control(now, wanted)
        is_ready = now.status.armed and wanted is None and climb_m is None and objection is None
        self.waits_for = None if is_ready else objection or self._lack(now, wanted, climb_m)
        is_heard = now.status.armed or now.link.echo_confirmed
        is_due = is_heard and now.now_ns >= self.request_due_ns
        if self.waits_for is None or objection is not None or not is_due:
            return EngagementOutput(control=control)
        if control is ControlSource.NEUTRAL and (self.settings.is_setpoint or self.lends_sticks):
            if self.flows_from_ns is None:
                self.flows_from_ns = now.now_ns
            if now.now_ns - self.flows_from_ns < FLOW_NS:
                return EngagementOutput(control=control)
        if climb_m is not None and now.status.is_landed is False:
            return EngagementOutput(control=control)
        self.request_due_ns = now.now_ns + REQUEST_SPACING_NS
        self.asked_mode = wanted
        arm = wanted is None and not now.status.armed
        return EngagementOutput(control=control, mode=wanted, arm=arm, takeoff_m=climb_m)

    def _lend_sticks(self, now: EngagementInputs, wanted: str | None) -> None:
        """Start neutral sticks if PX4 has refused a mode that it enters only with sticks.

        From then on silence would be a failsafe.
        """
        is_refused = wanted is not None and now.link.refused_mode == wanted == self.asked_mode
        is_flown = wanted not in now.link.modes.setpoint and not self.settings.is_setpoint
        lacks_sticks = now.link.modes.needs_sticks_first and now.status.has_receiver is False
        if is_refused and is_flown and lacks_sticks and not self.has_sticks:
            self.lends_sticks, self.request_due_ns = True, now.now_ns

    def _watch_climb(self, now: EngagementInputs) -> None:
        takeoff_m = self.settings.takeoff_m
        if not now.status.armed:
            self.ground_m = now.status.height_m
        elif not self.is_up and now.status.height_m is not None and takeoff_m is not None:
            self.ground_m = now.status.height_m if self.ground_m is None else self.ground_m
            self.is_up = now.status.height_m - self.ground_m >= ARRIVED * takeoff_m

    def _lack(self, now: EngagementInputs, wanted: str | None, climb_m: float | None) -> Reason:
        if not self.is_up and now.status.height_m is None:
            return because(Code.TAKEOFF_NEEDS_POSITION)
        if climb_m is not None:
            return because(Code.TAKING_OFF, height_m=climb_m)
        if wanted is not None:
            return because(Code.WAITING_FOR_MODE, mode=wanted)
        return because(Code.WAITING_FOR_ARMING)

    def _control(self, now: EngagementInputs, wanted: str | None) -> ControlSource | None:
        """Return the source to send during the sequence.

        A person who armed the vehicle keeps the sticks until the policy takes over. Setpoints would
        end a takeoff, but some modes can be entered only while setpoints flow.
        """
        is_climbing = self.arms and now.status.armed and self.settings.takeoff_m is not None
        if now.link.problem is not None:
            # Without a receiver the end of sticks is a failsafe, even if we hear nothing.
            is_held = (is_climbing or self.lends_sticks) and not self.settings.is_setpoint
            return ControlSource.NEUTRAL if is_held else None
        if self.settings.is_setpoint:
            if not self.is_up:
                return None
            if self.arms and self.settings.takeoff_m is None:
                return ControlSource.IDLE
            mode = wanted or now.status.mode  # setpoints also keep the mode once entered
            needs_flow = now.link.modes.needs_setpoints_first and mode in now.link.modes.setpoint
            return ControlSource.NEUTRAL if needs_flow else None
        if not self.has_sticks:
            return None
        is_flown = is_climbing or self.lends_sticks
        return ControlSource.NEUTRAL if is_flown else ControlSource.IDLE


@dataclass(slots=True)
class DisengageSequence:
    """Neutral, a safe mode, then the release: ``begin`` starts, ``step`` continues."""

    settings: EngagementSettings
    mode: str | None = None
    """Requested safe mode; a change to it is no takeover."""
    is_done: bool = False
    must_hold: bool = False
    """True if neutral must go on: silence is a failsafe, or nobody would hold the vehicle."""
    is_silence_failsafe: bool = False
    """True if the end of our sticks triggers the vehicle's failsafe."""
    may_release: bool = False
    """True if the receiver's sticks would hold the vehicle in the flight's mode."""
    unheld_mode: str = ""
    """Mode to request after a release to sticks that would not."""
    is_thrust_mode: bool = False
    began_ns: int = 0
    request_due_ns: int = 0
    asks_until_ns: int = 0
    """End of the frequent requests: a vehicle that is heard has had time to confirm."""
    asked_ns: int | None = None
    """Last request for the safe mode."""
    entered_ns: int = 0
    """Last request for the safe mode, or the first time after it that the mode was seen."""
    missed_ns: int = -2 * UNDONE_NS
    """Last time at which the vehicle perhaps did not get our sticks."""
    undone_ns: int | None = None
    """First time that the vehicle was seen in the mode that it enters when sticks move."""
    has_failed: bool = False
    """True if a command has failed since ``begin``."""

    def ask_at_once(self, now_ns: int) -> None:
        """Request the mode at the next step, without waiting for the spacing."""
        self.request_due_ns, self.asks_until_ns = now_ns, now_ns + MODE_TIMEOUT_NS

    def begin(self, now: EngagementInputs, *, is_planned: bool) -> Reason | None:
        """Choose the safe mode. Return why a release that the flag demands is refused, or None."""
        self.ask_at_once(now.now_ns)
        self.began_ns = now.now_ns
        self.asked_ns = self.undone_ns = None
        self.has_failed = False
        self.is_thrust_mode = now.status.mode in now.link.modes.thrust
        self.is_silence_failsafe = (
            now.status.has_receiver is not True or now.link.modes.is_silence_failsafe
        )
        choice, note = self.settings.then if is_planned else self.settings.on_fault, None
        objection = self.hand_objection(now)
        self.may_release = objection is None
        if choice in ("auto", "release"):
            instead: OnFault = "land" if is_planned else "hold"
            if objection is not None and choice == "release":
                note = because(Code.NOT_RELEASED, instead=instead, why=objection)
            # Centred sticks would let a vehicle drift that its policy has stopped.
            is_kept = choice == "auto" and self.settings.keeps_place and is_planned
            released: OnFault = "hold" if is_kept else "release"
            choice = released if objection is None else instead
        # A pilot's sticks would do nothing in a setpoint mode or during the autopilot's takeoff.
        is_deaf = now.status.mode in (*now.link.modes.setpoint, *now.link.modes.takeoff)
        if choice == "release" and (self.settings.is_setpoint or is_deaf):
            choice = "hold"
        is_lost = now.status.is_position_valid is False
        if choice == "hold" and is_lost:
            choice = "land"  # BRAKE and LOITER are refused without a position
        roles = now.link.modes
        by_choice = {"hold": roles.hold, "land": roles.land, "rtl": roles.rtl}
        self.mode = by_choice.get(choice) or None
        self.unheld_mode = roles.land if is_planned or is_lost else roles.hold
        return note

    def hand_objection(self, now: EngagementInputs) -> Reason | None:
        """Return why the pilot's sticks would not hold the vehicle in its present mode, or None."""
        if now.status.has_receiver is not True:
            return because(Code.NO_RECEIVER)
        pilot, is_thrust = now.status.pilot_sticks, now.status.mode in now.link.modes.thrust
        lifts_from = -MIDDLE_STICK if is_thrust else MIDDLE_STICK
        if now.status.is_landed and (pilot is None or pilot.throttle <= lifts_from):
            return None  # it stays there
        # The silence of the whole vehicle tells nothing about its receiver.
        is_heard = now.heard_ns is None or now.now_ns - now.heard_ns <= GAP_NS / 2
        if now.status.is_receiver_sick or (is_heard and not any(now.status.rc_channels_us)):
            return because(Code.RECEIVER_LOST)
        if now.link.modes.is_silence_failsafe and not self.settings.is_setpoint:
            return because(Code.SILENCE_IS_FAILSAFE)
        if is_thrust:
            return because(Code.THROTTLE_IS_THRUST, mode=now.status.mode)
        if pilot is None:
            return because(Code.THROTTLE_UNKNOWN)
        if abs(pilot.throttle) > MIDDLE_STICK:
            percent, most = 100 * pilot.throttle, 100 * MIDDLE_STICK
            return because(Code.THROTTLE_RESTS, percent=percent, limit_percent=most)
        return None

    def is_undone(self, now: EngagementInputs) -> bool:
        """True if our own sticks made the vehicle leave the safe mode, or may have.

        The vehicle shows our sticks and no others, and its EVENT reports moved sticks.
        """
        if self.mode is None or self.asked_ns is None or now.status.mode != now.link.modes.override:
            return False
        if not now.link.echo_confirmed or now.link.overruled is not None:
            return False
        undone_ns = now.now_ns if self.undone_ns is None else self.undone_ns
        is_undecided = now.now_ns - undone_ns <= WORD_NS
        is_new = undone_ns - max(self.entered_ns, self.missed_ns) <= UNDONE_NS
        return is_new and (is_undecided or self._is_told(now))

    def _is_told(self, now: EngagementInputs) -> bool:
        """True if an EVENT tells of moved sticks, or ours were missing: then a hand is shown."""
        told_ns, undone_ns = now.status.stick_override_ns, self.undone_ns
        if undone_ns is not None and undone_ns - self.missed_ns <= UNDONE_NS:
            return True
        return told_ns is not None and self.asked_ns is not None and told_ns >= self.asked_ns

    def _watch_undoing(self, now: EngagementInputs) -> None:
        if now.link.problem is not None:
            self.missed_ns = now.now_ns
        is_shown = now.link.echo_confirmed and now.link.overruled is None
        if self.mode is None or self.asked_ns is None or not is_shown:
            return
        if now.status.mode == now.link.modes.override:
            self.undone_ns = now.now_ns if self.undone_ns is None else self.undone_ns
        elif self.undone_ns is not None:  # back in our mode: the next exit needs its own EVENT
            self.asked_ns, self.undone_ns = now.now_ns, None

    def _are_at_rest(self, now: EngagementInputs) -> bool:
        """True if neutral sticks were sent and no longer look like a hand."""
        if self.settings.is_setpoint or not now.link.modes.override:
            return True
        is_bounded = now.now_ns - self.began_ns >= STICK_REST_NS
        self.has_failed = self.has_failed or now.command_fault is not None
        is_known = not self.has_failed and now.now_ns > self.began_ns  # when neutral was sent
        return is_bounded or (is_known and now.link.are_sticks_at_rest)

    def _may_ask(self, now: EngagementInputs, unheard_ns: int | None) -> bool:
        """True if the mode is known, or the vehicle's failsafe cannot have acted yet."""
        has_failsafe = self.is_silence_failsafe or now.link.modes.needs_setpoints_first
        blind_ns = FAILSAFE_BLIND_NS if has_failsafe else BLIND_NS
        return unheard_ns is None or now.now_ns - unheard_ns <= blind_ns

    def step(self, now: EngagementInputs, unheard_ns: int | None) -> EngagementOutput:
        """Send neutral, and request the mode until it is confirmed or refused.

        ``unheard_ns``: last message of a vehicle whose mode is unknown since; None: known.
        """
        is_confirmed = self.mode is None or now.status.mode == self.mode
        # PX4's safe modes give way to a stick that is not in the middle when its receiver follows.
        is_kept = self.mode is not None and is_confirmed and not now.link.modes.override
        is_safe = self.may_release or is_kept
        self.must_hold = self.is_silence_failsafe or not is_safe
        if self.settings.is_setpoint:  # silence leaves ArduPilot in our mode, to nobody
            self.must_hold = not (is_confirmed or now.link.modes.needs_setpoints_first)
        if unheard_ns is not None:  # the timeout starts when the vehicle is heard
            self.asks_until_ns = now.now_ns + MODE_TIMEOUT_NS
        # A refusal before our request is an earlier flight's. No vehicle refuses to land: such an
        # answer is a late one to the previous request.
        has_asked = self.asked_ns is not None
        if has_asked and not is_confirmed and now.link.refused_mode == self.mode:
            self.mode = now.link.modes.land or None
        elapsed_ns = now.now_ns - self.began_ns
        self._watch_undoing(now)
        is_undone = self.is_undone(now)
        if is_confirmed and self.asked_ns is not None and self.entered_ns <= self.asked_ns:
            self.entered_ns = now.now_ns
        is_late = now.now_ns >= self.asks_until_ns
        is_over = elapsed_ns >= NEUTRAL_NS if is_confirmed else is_late
        self.is_done = is_over and not is_undone
        # In thrust modes neutral would climb or fall, so the mode change comes first. Even after
        # it, the vehicle may take our jump to neutral for a hand.
        is_level = self.is_thrust_mode and not is_kept
        control: ControlSource | None = ControlSource.LEVEL if is_level else ControlSource.NEUTRAL
        if self.settings.is_setpoint and now.status.is_landed:
            control = ControlSource.IDLE  # hover thrust would lift it
        may_pull_back = self.settings.is_setpoint and now.link.modes.needs_setpoints_first
        if may_pull_back and elapsed_ns > SETPOINT_NS:
            control = None
        is_due = now.now_ns >= self.request_due_ns and self._may_ask(now, unheard_ns)
        if is_confirmed or not is_due:
            return EngagementOutput(control=control)
        if (is_undone and not self._is_told(now)) or not self._are_at_rest(now):
            return EngagementOutput(control=control)
        if not is_undone:
            self.asked_ns = self.entered_ns = now.now_ns
        is_slow = is_late and now.link.problem is None  # each refusal prints a reason
        self.request_due_ns = now.now_ns + (SLOW_SPACING_NS if is_slow else MODE_SPACING_NS)
        return EngagementOutput(control=control, mode=self.mode)
