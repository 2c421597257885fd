"""Arming, modes and failsafes, with their texts and events, as PX4's commander decides them.

The intended mode is the last one that the pilot or a command requested. The flown mode is ``mode``;
a failsafe may change it and leaves the intended one alone.
"""

from typing import Literal, NamedTuple

from sitl.clock import NS_PER_MS, NS_PER_S
from sitl.px4.flight import Setpoint
from sitl.px4.modes import LostSticks, Phase, Px4Mode, mode_without_stream
from sitl.px4.params import Px4Params
from sitl.px4.sticks import StickInput
from sitl.vehicle.config import VehicleConfig
from sitl.vehicle.firmware import Autopilot, Severity

_AUTOPILOT_COMPONENT = 1 << 24
_FNV1A_32_OFFSET, _FNV1A_32_PRIME = 0x811C9DC5, 0x01000193

DisarmReason = Literal["external command", "landing", "auto preflight disarming"]


class Event(NamedTuple):
    """One EVENT(410), without its arguments; ``uptime_ms`` is its time since boot.

    Its number is the autopilot's component in the upper bits and a hash of its name below
    (MAVLink's events interface).
    """

    name: str
    uptime_ms: int

    @property
    def number(self) -> int:
        value = _FNV1A_32_OFFSET
        for letter in self.name.encode():
            value = (value ^ letter) * _FNV1A_32_PRIME & 0xFFFFFFFF
        return _AUTOPILOT_COMPONENT | value & 0xFFFFFF


CHECK_PERIOD_NS = 20 * NS_PER_MS
LOW_THROTTLE, MIDDLE_THROTTLE = -0.8, 0.2
"""Highest throttle for arming in modes where the stick is thrust, and where it is a climb rate."""


class Commander(Autopilot):
    """Decides on mode and arming during one boot; texts and events wait in lists for the links."""

    params: Px4Params

    def __init__(self, params: Px4Params, config: VehicleConfig, boot_ns: int) -> None:
        super().__init__(params, config, boot_ns)
        self.mode = self.intended = self._last_armable = Px4Mode.AUTO_LOITER
        self.stick_input = StickInput(params)
        self.lost_sticks = LostSticks(params)
        self.events: list[Event] = []  # events to send; the reader empties the list
        self.setpoint: Setpoint | None = None
        self.setpoint_count = 0
        self._setpoint_ns = boot_ns
        self._fallback = False
        self._sticks_missed = True  # the loss of sticks has been noticed
        self._was_lost = False
        self._ignores_sticks = False  # no failsafe: sticks were absent at arming
        self._armed_ns = self._landed_ns = self._check_due_ns = boot_ns
        self._has_flown = False

    @property
    def mode_name(self) -> str:
        return self.mode.label

    @property
    def in_failsafe(self) -> bool:
        return self.armed and (self.lost_sticks.active or self._fallback)

    def set_setpoint(self, setpoint: Setpoint, now_ns: int) -> None:
        """Take a setpoint, which only OFFBOARD uses."""
        self.setpoint, self._setpoint_ns = setpoint, now_ns
        self.setpoint_count += 1

    def can_fly(self, mode: Px4Mode) -> bool:
        """True if the mode has the sticks, position or stream of setpoints that it needs."""
        if mode.piloted and not self.stick_input.valid:
            return False
        if mode.needs_position and not self.position_ready:
            return False
        return mode is not Px4Mode.OFFBOARD or self._has_stream

    @property
    def _has_stream(self) -> bool:
        """True until the newest setpoint is COM_OF_LOSS_T old."""
        age_ns = self.now_ns - self._setpoint_ns
        return self.setpoint is not None and age_ns < self.params["COM_OF_LOSS_T"] * NS_PER_S

    def can_arm(self) -> bool:
        """True if the vehicle's health allows arming; sticks may still be too high."""
        return self.estimator_ready and self.intended.armable and self.can_fly(self.intended)

    def arm(self) -> bool:
        if self.armed:
            return True
        if not self.can_arm():
            self._deny(
                "Arming denied: Resolve system health failures first",
                "commander_arm_denied_resolve_failures",
            )
            return False
        throttle, is_safe = self.stick_input.sticks.throttle, True
        if self.intended.manual_throttle:
            is_safe = throttle < LOW_THROTTLE
        elif self.intended.piloted:
            is_safe = throttle <= MIDDLE_THROTTLE
        if not is_safe:
            self._deny(
                "Arming denied: throttle not in safe position",
                "commander_arm_denied_throttle_unsafe",
            )
            return False
        self.start_motors(ignores_sticks=not self.stick_input.valid)
        self._tell("Armed by external command", "commander_armed_by")
        return True

    def start_motors(self, *, ignores_sticks: bool) -> None:
        self.armed, self._has_flown = True, False
        self._armed_ns = self.now_ns
        self._ignores_sticks = ignores_sticks
        self._sticks_missed = not self.stick_input.valid

    def disarm(self, *, force: bool, reason: DisarmReason = "external command") -> bool:
        if not self.armed:
            return True
        if not (self.landed or force):
            self._deny("Disarming denied: not landed", "commander_disarm_denied_not_landed")
            return False
        self.armed = self._fallback = False
        self.lost_sticks.clear()
        self._tell(f"Disarmed by {reason}", "commander_disarmed_by")
        if not self.intended.armable:
            self.intended = self._last_armable
        self.mode = self.intended
        return True

    def set_mode(self, mode: Px4Mode) -> bool:
        """Take a commanded mode. Return True if it is the intended one afterwards.

        The firmware also sends a refusal as a text, but not to a companion computer.
        """
        if self.armed and mode is not Px4Mode.AUTO_LAND and not self.can_fly(mode):
            return False
        self._intend(mode)
        return True

    def _set_landed(self, *, landed: bool) -> None:
        super()._set_landed(landed=landed)
        self._landed_ns = self.now_ns
        self._has_flown = self._has_flown or not landed
        what = "landing" if landed else "takeoff"
        self._tell(f"{what.capitalize()} detected", f"commander_{what}_detected")

    def _read_inputs(self) -> None:
        if self.lost_sticks.update(self.step_ns):
            self._say_failsafe()
        if self.now_ns >= self._check_due_ns:
            self._check_due_ns = self.now_ns + CHECK_PERIOD_NS
            self._watch_sticks()
        if self.armed:
            self._yield_to_pilot()
            self._disarm_by_time()
        self._choose_mode()

    def _watch_sticks(self) -> None:
        """Start the failsafe if sticks are lost in flight; sticks absent at arming are ignored."""
        if self.stick_input.valid:
            if self._sticks_missed and self._was_lost:
                self._emit("commander_rc_regained")
            self._sticks_missed = self._ignores_sticks = False
            return
        if self._sticks_missed:
            return
        self._sticks_missed = self._was_lost = True
        self._emit("commander_rc_lost")
        is_excepted = self.lost_sticks.is_excepted(self.intended)
        if not self.armed or self._ignores_sticks or is_excepted or self.lost_sticks.active:
            return
        if not self.params.integer("NAV_RCL_ACT"):
            return
        self.lost_sticks.start()
        is_held = self.lost_sticks.phase is Phase.HOLDING
        self._say_failsafe(self.lost_sticks.delay_s if is_held else None)

    def _yield_to_pilot(self) -> None:
        """Let fast sticks take over an autonomous flight, except in a failsafe's Hold."""
        is_held = self.lost_sticks.phase is Phase.HOLDING
        bits = int(self.params.get("COM_RC_OVERRIDE", 0b11))  # 1.18 has no parameter and does both
        is_offboard = self.mode is Px4Mode.OFFBOARD
        is_autonomous = bits & (1 if self.mode.is_auto else 2 if is_offboard else 0)
        if self.stick_input.moved_fast and is_autonomous and not is_held and not self.landed:
            was_failsafe = self.in_failsafe
            self._intend(Px4Mode.POSCTL if self.position_ready else Px4Mode.ALTCTL)
            if was_failsafe:
                self._emit("failsafe_rc_override")
            else:
                self._tell("Pilot took over using sticks", "commander_rc_override")

    def _disarm_by_time(self) -> None:
        if not self.landed:
            return
        name = "COM_DISARM_LAND" if self._has_flown else "COM_DISARM_PRFLT"
        since_ns = self._landed_ns if self._has_flown else self._armed_ns
        limit_s = self.params[name]
        if limit_s > 0.0 and self.now_ns - since_ns >= limit_s * NS_PER_S:
            self.disarm(
                force=False, reason="landing" if self._has_flown else "auto preflight disarming"
            )

    def _choose_mode(self) -> None:
        if not self.armed:
            self.mode, self._fallback = self.intended, False
            return
        if self.lost_sticks.active:
            self.mode = self._with_position(self.lost_sticks.mode())
            return
        wanted = self.intended
        if wanted is Px4Mode.OFFBOARD and not self._has_stream:
            wanted = mode_without_stream(self.params, has_sticks=self.stick_input.valid)
        wanted = self._with_position(wanted)
        was_fallback, self._fallback = self._fallback, wanted is not self.intended
        self.mode = wanted
        if self._fallback and not was_fallback:
            self._say_failsafe()

    def _with_position(self, mode: Px4Mode) -> Px4Mode:
        if self.position_ready or not mode.needs_position:
            return mode
        is_stick_flown = mode is Px4Mode.POSCTL and self.stick_input.valid
        return Px4Mode.ALTCTL if is_stick_flown else Px4Mode.AUTO_LAND

    def _intend(self, mode: Px4Mode) -> None:
        if self.intended.armable:
            self._last_armable = self.intended
        self.intended = self.mode = mode
        self._fallback = False
        self.lost_sticks.clear()

    def _say_failsafe(self, hold_s: float | None = None) -> None:
        if hold_s is None:
            self._deny("Failsafe activated", "commander_failsafe_enter")
        else:
            text = f"Failsafe activated: entering Hold for {int(hold_s)} seconds"
            self._deny(text, "commander_failsafe_enter_hold")

    def _deny(self, text: str, event: str) -> None:
        self._tell(text, event, Severity.CRITICAL)

    def _tell(self, text: str, event: str, severity: Severity = Severity.INFO) -> None:
        # The tab marks a text that is also sent as an event; ground stations hide it.
        self.send_text(severity, text + "\t")
        self._emit(event)

    def _emit(self, name: str) -> None:
        self.events.append(Event(name, self.uptime_ns // NS_PER_MS))
