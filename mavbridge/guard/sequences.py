"""The two sequences of steps that are more than a state: into a flight, and out of one."""

from dataclasses import dataclass

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.vehicle import OnFault
from mavbridge.guard.values import Actions, ControlSource, EngagementInputs

REQUEST_SPACING_NS = NS_PER_S
"""Between two requests to arm or for a mode: each refused one prints the vehicle's reason."""
ARRIVED = 0.9
"""Share of the takeoff height at which the policy's mode is asked for."""
FLOW_NS = 100 * NS_PER_MS
"""Setpoints flow for so long before a mode is asked for that needs them: PX4 took OFFBOARD 20 ms
after the first, and refused it when asked together with it."""
NEUTRAL_NS = 50 * NS_PER_MS
"""Least time of neutral sticks before they are given back."""
MODE_SPACING_NS = 100 * NS_PER_MS
"""Between two requests for the safe mode; ArduPilot answers within 10 ms."""
SLOW_SPACING_NS = NS_PER_S
"""The same once a vehicle with a good link has not confirmed it for the timeout."""
MODE_TIMEOUT_NS = 3 * NS_PER_S
"""Longest wait for the safe mode of a vehicle that is heard; HEARTBEAT, which confirms it, may come
at 1 Hz."""
BLIND_NS = 3 * NS_PER_S
"""Longest that a vehicle which is not heard is asked for a mode, where a receiver takes over from
sticks that stay away: a failsafe for want of a ground station comes after 5 s."""
FAILSAFE_BLIND_NS = 500 * NS_PER_MS
"""The same where its own failsafe follows, which must not be undone: after 0.5 s (COM_RC_LOSS_T) or
1 s (RC_FS_TIMEOUT, COM_OF_LOSS_T)."""
SETPOINT_NS = 500 * NS_PER_MS
"""Longest stream of neutral setpoints that waits for the mode on PX4. A vehicle that has not
answered by then does not hear us, and it goes back to OFFBOARD within 30 ms when it hears a
setpoint after its own failsafe (COM_OF_LOSS_T, 1 s)."""
STICK_REST_NS = NS_PER_S
"""Longest wait for our sticks to be at rest before the safe mode is asked for all the same: a jump
over the whole range is slower than PX4's least hand, 0.05 a second, after 0.6 s."""
UNDONE_NS = NS_PER_S
"""A safe mode that PX4 leaves this soon for moving sticks was left for our jump to neutral."""
WORD_NS = 100 * NS_PER_MS
"""Wait for the EVENT that tells it from another station's change of mode, which has none."""
MIDDLE_STICK = 0.2
"""A receiver's throttle this near to the middle holds height or nearly so (ArduPilot's THR_DZ is
0.2 of the stick's travel to each side)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EngageSettings:
    """State that the vehicle has to be in before the policy flies."""

    modes: tuple[str, ...]
    """Modes in which the policy may fly."""
    mode: str | None = None
    """The one of them to ask for; None = the present one, or when we arm it the first of modes."""
    takeoff_m: float | None = None
    """Height above the place of arming to which the autopilot climbs by itself, when we arm it."""
    is_setpoint: bool = False
    """The policy's actions are setpoints, and not sticks."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DisengageSettings:
    """Actions after a fault, and at a normal end."""

    on_fault: OnFault = "auto"
    """auto: release to a hand that would hold the vehicle, else hold."""
    then: OnFault = "auto"
    """auto: release to a hand that would hold the vehicle, else land."""
    is_setpoint: bool = False
    """The policy's actions are setpoints: there is nothing to release to, so that a mode which
    holds stands for release, and silence follows it."""


@dataclass(slots=True)
class EngageSequence:
    """Mode, arming, takeoff: ``begin`` starts it, ``step`` goes on until it waits for nothing."""

    settings: EngageSettings
    waits_for: Reason | None = None
    """What is missing; None: ready to fly."""
    arms: bool = False
    """It was disarmed at the beginning: we keep it idle on the ground, and arm it."""
    asked_mode: str | None = None
    request_due_ns: int = 0
    is_up: bool = False
    """No takeoff is wanted, or the height is reached."""
    ground_m: float | None = None
    flows_from_ns: int | None = None
    """First setpoint of those that a mode needs before it is entered."""
    lends_sticks: bool = False
    """The mode was refused to a vehicle in the air that has no sticks: neutral ones flow."""

    def begin(self, now: EngagementInputs) -> None:
        """Start with the vehicle as it is now."""
        self.arms = not now.armed
        self.is_up = self.settings.takeoff_m is None or not self.arms
        self.asked_mode = self.ground_m = self.flows_from_ns = None
        self.lends_sticks = False

    @property
    def has_sticks(self) -> bool:
        """Ours are the vehicle's while this goes on."""
        return self.arms or self.lends_sticks

    def is_own_mode(self, now: EngagementInputs) -> bool:
        """The present mode was asked for, or is one that the autopilot's takeoff goes through."""
        has_takeoff = self.settings.takeoff_m is not None and self.arms
        return now.mode == self.asked_mode or (has_takeoff and now.mode in now.modes.takeoff)

    def may_change_mode(self, now: EngagementInputs) -> bool:
        """An act asks for another mode: the flag's, or one that only our setpoints can enter."""
        if self.settings.mode is not None:
            return now.mode != self.settings.mode
        needs_flow = self.settings.is_setpoint and now.modes.needs_setpoints_first
        return needs_flow and now.mode not in self.settings.modes

    def wanted_mode(self, now: EngagementInputs) -> str | None:
        """Mode to ask for; None if the present one will do."""
        wanted = self.settings.mode
        if not self.is_up:
            wanted = now.mode if now.armed else next(iter(now.modes.takeoff), None)
        elif wanted is None and now.mode not in self.settings.modes:
            known = [mode for mode in self.settings.modes if mode in now.modes.names]
            wanted = known[0] if known else self.settings.modes[0]
        return None if wanted == now.mode else wanted

    def impossibility(self, now: EngagementInputs) -> Reason | None:
        """Why waiting will not help, or None."""
        names, wanted = now.modes.names, self.wanted_mode(now)
        if wanted is None or not names or wanted in names:
            return now.slowness
        return because(Code.NO_SUCH_MODE, mode=wanted, modes=", ".join(names))

    def step(self, now: EngagementInputs, objection: Reason | None) -> Actions:
        """Advance; with an ``objection`` nothing new is asked for."""
        self._watch_climb(now)
        wanted = self.wanted_mode(now)
        climb_m = self.settings.takeoff_m if not self.is_up and now.armed else None
        self._lend_sticks(now, wanted)
        control = self._control(now, wanted)
        is_ready = now.armed and wanted is None and climb_m is None and objection is None
        self.waits_for = None if is_ready else objection or self._lack(now, wanted, climb_m)
        is_heard = now.armed or now.echo_confirmed
        if self.waits_for is None or objection is not None or not is_heard:
            return Actions(control=control)
        if now.now_ns < self.request_due_ns:
            return Actions(control=control)
        if control is ControlSource.NEUTRAL and (self.settings.is_setpoint or self.lends_sticks):
            if self.flows_from_ns is None:
                self.flows_from_ns = now.now_ns
            if now.now_ns - self.flows_from_ns < FLOW_NS:
                return Actions(control=control)
        if climb_m is not None and now.is_landed is False:
            return Actions(control=control)
        self.request_due_ns = now.now_ns + REQUEST_SPACING_NS
        self.asked_mode = wanted
        arm = wanted is None and not now.armed
        return Actions(control=control, mode=wanted, arm=arm, takeoff_m=climb_m)

    def _lend_sticks(self, now: EngagementInputs, wanted: str | None) -> None:
        """Send neutral sticks once a mode was refused that PX4 enters only with some.

        From then on silence would be a failsafe.
        """
        is_refused = wanted is not None and now.refused_mode == wanted == self.asked_mode
        is_flown = wanted not in now.modes.setpoint and not self.settings.is_setpoint
        lacks_sticks = now.modes.needs_sticks_first and now.has_receiver is False
        if is_refused and is_flown and lacks_sticks and not self.has_sticks:
            self.lends_sticks, self.request_due_ns = True, now.now_ns

    def _watch_climb(self, now: EngagementInputs) -> None:
        takeoff_m = self.settings.takeoff_m
        if not now.armed:
            self.ground_m = now.height_m
        elif not self.is_up and now.height_m is not None and takeoff_m is not None:
            self.ground_m = now.height_m if self.ground_m is None else self.ground_m
            self.is_up = now.height_m - self.ground_m >= ARRIVED * takeoff_m

    def _lack(self, now: EngagementInputs, wanted: str | None, climb_m: float | None) -> Reason:
        if not self.is_up and now.height_m is None:
            return because(Code.TAKEOFF_NEEDS_POSITION)
        if climb_m is not None:
            return because(Code.TAKING_OFF, height_m=climb_m)
        if wanted is not None:
            return because(Code.WAITING_FOR_MODE, mode=wanted)
        return because(Code.WAITING_FOR_ARMING)

    def _control(self, now: EngagementInputs, wanted: str | None) -> ControlSource | None:
        """What to send meanwhile.

        Somebody who has armed it keeps the sticks until the policy takes them. Setpoints end a
        takeoff, but some modes are only entered while they flow.
        """
        is_climbing = self.arms and now.armed and self.settings.takeoff_m is not None
        if now.link_problem is not None:
            # Sticks that end are a failsafe where there is no receiver, also if we hear nothing.
            is_held = is_climbing and not self.settings.is_setpoint
            return ControlSource.NEUTRAL if is_held else None
        if self.settings.is_setpoint:
            if not self.is_up:
                return None
            if self.arms and self.settings.takeoff_m is None:
                return ControlSource.IDLE
            mode = wanted or now.mode  # and once entered, it is kept only by them
            needs_flow = now.modes.needs_setpoints_first and mode in now.modes.setpoint
            return ControlSource.NEUTRAL if needs_flow else None
        if not self.has_sticks:
            return None
        is_flown = is_climbing or self.lends_sticks
        return ControlSource.NEUTRAL if is_flown else ControlSource.IDLE


@dataclass(slots=True)
class DisengageSequence:
    """Neutral, a safe mode, then the release: ``begin`` starts it, ``step`` goes on."""

    settings: DisengageSettings
    mode: str | None = None
    """The safe mode that is asked for; a change to it is no takeover."""
    is_done: bool = False
    must_hold: bool = False
    """Neutral must go on: silence is a failsafe, or the receiver would drop the vehicle."""
    is_silence_failsafe: bool = False
    """The vehicle takes the end of our sticks for a failsafe."""
    may_release: bool = False
    """The receiver's sticks would hold the vehicle in the mode of the flight."""
    is_thrust_mode: bool = False
    began_ns: int = 0
    request_due_ns: int = 0
    asks_until_ns: int = 0
    """End of the quick requests: a vehicle that is heard has had its time to confirm."""
    asked_ns: int | None = None
    """The safe mode was last asked for."""
    entered_ns: int = 0
    """It was asked for, or seen for the first time after that."""
    undone_ns: int | None = None
    """The vehicle was first seen in the mode that it enters for a moving stick."""
    has_failed: bool = False
    """A command could not be made on this way out."""

    def ask_at_once(self, now_ns: int) -> None:
        """Let the next request for the mode wait for no spacing."""
        self.request_due_ns, self.asks_until_ns = now_ns, now_ns + MODE_TIMEOUT_NS

    def begin(self, now: EngagementInputs, *, is_fault: bool) -> Reason | None:
        """Choose the safe mode; returns why it is not released although the flag says so."""
        self.ask_at_once(now.now_ns)
        self.began_ns = now.now_ns
        self.asked_ns = self.undone_ns = None
        self.has_failed = self.is_done = False
        self.is_thrust_mode = now.mode in now.modes.thrust
        self.is_silence_failsafe = now.has_receiver is not True or now.modes.is_silence_failsafe
        choice, note = self.settings.on_fault if is_fault else self.settings.then, None
        objection = self._hand_objection(now)
        self.may_release = objection is None
        if choice == "release" and now.is_landed:
            self.may_release = True
        elif choice in ("auto", "release"):
            instead: OnFault = "hold" if is_fault else "land"
            if objection is not None and choice == "release":
                note = because(Code.NOT_RELEASED, instead=instead, why=objection)
            choice = "release" if objection is None else instead
        # In a mode of setpoints or of the autopilot's takeoff a pilot's sticks would do nothing.
        is_deaf = now.mode in (*now.modes.setpoint, *now.modes.takeoff)
        if choice == "release" and (self.settings.is_setpoint or is_deaf):
            choice = "hold"
        if choice == "hold" and not now.is_position_valid:
            choice = "land"  # BRAKE and LOITER are refused without a position
        roles = now.modes
        by_choice = {"hold": roles.hold, "land": roles.land, "rtl": roles.rtl}
        self.mode = by_choice.get(choice) or None
        return note

    def _hand_objection(self, now: EngagementInputs) -> Reason | None:
        """Why the pilot's sticks would not hold the vehicle in its present mode, or None."""
        if now.has_receiver is not True:
            return because(Code.NO_RECEIVER)
        if now.is_landed:
            return None
        if now.is_receiver_sick:
            return because(Code.RECEIVER_LOST)
        if now.modes.is_silence_failsafe and not self.settings.is_setpoint:
            return because(Code.SILENCE_IS_FAILSAFE)
        if now.mode in now.modes.thrust:
            return because(Code.THROTTLE_IS_THRUST, mode=now.mode)
        if now.pilot_sticks is None:
            return because(Code.THROTTLE_UNKNOWN)
        throttle = now.pilot_sticks.throttle
        if abs(throttle) > MIDDLE_STICK:
            percent, most = 100 * throttle, 100 * MIDDLE_STICK
            return because(Code.THROTTLE_RESTS, percent=percent, limit_percent=most)
        return None

    def is_undone(self, now: EngagementInputs) -> bool:
        """True if the vehicle has left our mode for a hand that nobody moved, or may have.

        It shows our sticks, and no others; its EVENT says that sticks were moved.
        """
        if self.mode is None or self.asked_ns is None or now.mode != now.modes.override:
            return False
        if not now.echo_confirmed or now.overruled is not None:
            return False
        undone_ns = now.now_ns if self.undone_ns is None else self.undone_ns
        is_undecided = now.now_ns - undone_ns <= WORD_NS
        return undone_ns - self.entered_ns <= UNDONE_NS and (is_undecided or self._is_told(now))

    def _is_told(self, now: EngagementInputs) -> bool:
        told_ns = now.stick_override_ns
        return told_ns is not None and self.asked_ns is not None and told_ns >= self.asked_ns

    def _watch_undoing(self, now: EngagementInputs) -> None:
        if self.mode is None or self.asked_ns is None:
            return
        if not now.echo_confirmed or now.overruled is not None:
            return
        if now.mode == now.modes.override:
            self.undone_ns = now.now_ns if self.undone_ns is None else self.undone_ns
        elif self.undone_ns is not None:  # back in our mode: another hand needs another word
            self.asked_ns, self.undone_ns = now.now_ns, None

    def _are_at_rest(self, now: EngagementInputs) -> bool:
        """Neutral sticks have left, and pass for nobody's hand."""
        if self.settings.is_setpoint or not now.modes.override:
            return True
        is_bounded = now.now_ns - self.began_ns >= STICK_REST_NS
        self.has_failed = self.has_failed or now.command_failed
        if self.has_failed:
            return is_bounded  # when neutral left is not known
        return is_bounded or (now.are_sticks_at_rest and now.now_ns > self.began_ns)

    def _may_ask(self, now: EngagementInputs, unheard_ns: int | None) -> bool:
        """The mode is known, or the vehicle's own failsafe cannot have acted yet."""
        has_failsafe = self.is_silence_failsafe or now.modes.needs_setpoints_first
        blind_ns = FAILSAFE_BLIND_NS if has_failsafe else BLIND_NS
        return unheard_ns is None or now.now_ns - unheard_ns <= blind_ns

    def step(self, now: EngagementInputs, unheard_ns: int | None) -> Actions:
        """Neutral, and the mode until it is confirmed or refused.

        ``unheard_ns``: last word of a vehicle that has not told its mode since; None: it is known.
        """
        is_confirmed = self.mode is None or now.mode == self.mode
        is_safe = self.may_release or (self.mode is not None and is_confirmed)
        self.must_hold = not self.settings.is_setpoint and (self.is_silence_failsafe or not is_safe)
        if unheard_ns is not None:  # its time to answer begins when it is heard
            self.asks_until_ns = now.now_ns + MODE_TIMEOUT_NS
        # No vehicle refuses to land: an answer that says so is a late one, to the mode before.
        if not is_confirmed and now.refused_mode == self.mode:
            self.mode = now.modes.land or None
        elapsed_ns = now.now_ns - self.began_ns
        self._watch_undoing(now)
        is_undone = self.is_undone(now)
        if is_confirmed and self.asked_ns is not None and self.entered_ns <= self.asked_ns:
            self.entered_ns = now.now_ns
        is_late = now.now_ns >= self.asks_until_ns
        is_over = elapsed_ns >= NEUTRAL_NS if is_confirmed else is_late
        self.is_done = not is_undone and (self.is_done or is_over)
        # Where the throttle is thrust, neutral would climb or fall: the mode goes first. Then it
        # may still be a hand's to the vehicle.
        is_entered = bool(self.mode) and is_confirmed and not now.modes.override
        is_level_only = self.is_thrust_mode and not is_entered
        control: ControlSource | None
        control = ControlSource.LEVEL if is_level_only else ControlSource.NEUTRAL
        if self.settings.is_setpoint and now.is_landed:
            control = ControlSource.IDLE  # the thrust that hovers would lift it
        may_pull_back = self.settings.is_setpoint and now.modes.needs_setpoints_first
        if may_pull_back and elapsed_ns > SETPOINT_NS:
            control = None
        is_due = now.now_ns >= self.request_due_ns and self._may_ask(now, unheard_ns)
        if is_confirmed or not is_due:
            return Actions(control=control)
        if (is_undone and not self._is_told(now)) or not self._are_at_rest(now):
            return Actions(control=control)
        if not is_undone:
            self.asked_ns = self.entered_ns = now.now_ns
        is_slow = is_late and now.link_problem is None  # each refusal prints a reason
        self.request_due_ns = now.now_ns + (SLOW_SPACING_NS if is_slow else MODE_SPACING_NS)
        return Actions(control=control, mode=self.mode)
