"""ArduCopter without its link: sticks in, physics out, in steps of 2.5 ms.

Modes, arming, failsafes and their status texts, word for word, as a pilot and a companion computer
see them. This module knows nothing about MAVLink, sockets or the host's time.
"""

import math

from sitl.ardupilot.flight_modes import CopterControl, Mode
from sitl.ardupilot.guided import GuidedControl
from sitl.ardupilot.params import ArduPilotParams
from sitl.ardupilot.rc import RcEngine, Sticks, climb_rate_mps, read_sticks
from sitl.clock import NS_PER_S
from sitl.vehicle.config import STEP_NS, VehicleConfig
from sitl.vehicle.dynamics import QUAD
from sitl.vehicle.firmware import STOPPED, Autopilot, Severity


class RadioFailsafe:
    """Failsafe for sticks absent for RC_FS_TIMEOUT."""

    def __init__(self, params: ArduPilotParams, now_ns: int) -> None:
        self._params = params
        self._last_input_ns = now_ns
        self.active = False

    def update(self, *, new_input: bool, can_fail: bool, now_ns: int) -> bool:
        """Check after one RC update. Return True if ``active`` has changed."""
        was_active = self.active
        if new_input or not self._params["FS_THR_ENABLE"]:
            self._last_input_ns, self.active = now_ns, False
        elif can_fail:
            timeout_ns = int(max(0.1, self._params["RC_FS_TIMEOUT"]) * NS_PER_S)
            self.active = self.active or now_ns - self._last_input_ns >= timeout_ns
        return self.active != was_active


FAILSAFE_MODES = {3: Mode.LAND, 7: Mode.BRAKE}
"""Mode that each value of FS_THR_ENABLE selects; all other values but 0 mean RTL."""
LAND_DELAY_NS = 4 * NS_PER_S  # LAND_WITH_DELAY_MS: time for the pilot to take over
FS_OPTION_GUIDED = 4  # GUIDED continues without the pilot's sticks
FS_OPTION_LANDING_CONTINUES = 8


class ArduCopter(Autopilot):
    """One boot of ArduCopter, stepped at 400 Hz."""

    step_ns = STEP_NS
    airframe = QUAD
    id_param = "MAV_SYSID"
    battery_mv = 12_600
    params: ArduPilotParams

    def __init__(self, params: ArduPilotParams, config: VehicleConfig, boot_ns: int) -> None:
        super().__init__(params, config, boot_ns)
        self.mode = Mode.STABILIZE
        self.rc = RcEngine(params, self.receiver)
        self.radio_failsafe = RadioFailsafe(params, boot_ns)
        self.control = CopterControl(params)
        """Targets and thrust, for telemetry to read; only this class commands it."""
        self._idle_since_ns = self._armed_ns = boot_ns

    @property
    def mode_name(self) -> str:
        return self.mode.name

    @property
    def in_failsafe(self) -> bool:
        return self.radio_failsafe.active

    @property
    def sticks_us(self) -> tuple[int, int, int, int]:
        return self.rc.sticks_us()

    @property
    def guided(self) -> GuidedControl | None:
        """Setpoint control in GUIDED and GUIDED_NOGPS; None in other modes."""
        return self.control.guided if self.mode.is_guided else None

    def prearm_refusal(self) -> str | None:
        """Return ArduCopter's reason to refuse arming in any mode (PREARM_CHECK), or None."""
        if not self.estimator_ready:
            return "AHRS: EKF3 not started"
        if not self.rc.found and self.params["FS_THR_ENABLE"]:
            return "RC not found"
        if self.radio_failsafe.active:
            return "Radio failsafe on"
        return None

    def _stick_refusal(self) -> str | None:
        """Return ArduCopter's reason why mode or sticks forbid arming, or None."""
        if not self.mode.can_arm:
            return f"{self.mode.name} mode not armable"
        if self.mode.needs_position and not self.position_ready:
            has_gps = math.isfinite(self.config.position_ready_s)
            return "Need Position Estimate" if has_gps else "GPS 1: Bad fix"
        sticks = read_sticks(self.rc, self.params)
        is_thrust = self.mode.manual_throttle and sticks.throttle > 0
        if is_thrust or climb_rate_mps(sticks, self.params) > 0.0:
            return "Throttle too high"
        for axis, value in (("Roll", sticks.roll), ("Pitch", sticks.pitch), ("Yaw", sticks.yaw)):
            if value != 0.0:
                return f"{axis} (RC{self.rc.index_of(axis.upper()) + 1}) is not neutral"
        return None

    def arm(self, *, force: bool = False) -> bool:
        if self.armed:
            return True
        refusal = self.prearm_refusal() or self._stick_refusal()
        if refusal is not None and not force:
            self.send_text(Severity.CRITICAL, f"Arm: {refusal}")
            return False
        self.armed = True
        self._armed_ns = self._idle_since_ns = self.now_ns
        self.control.enter(self.mode, self.sensed)
        self.send_text(Severity.INFO, "Arming motors")
        return True

    def disarm(self, *, force: bool) -> bool:
        if self.armed and not (self.landed or force):
            return False
        if self.armed:
            self.armed = False
            self.send_text(Severity.INFO, "Disarming motors")
        return True

    def take_off(self, height_m: float) -> bool:
        """Climb to a height above home (NAV_TAKEOFF). Return True if accepted.

        Only GUIDED climbs here; the firmware also climbs in ALT_HOLD and LOITER. GUIDED_NOGPS
        accepts and stays on the ground, as the firmware does.
        """
        is_climb = height_m > -self.sensed.position_ned_m[2]
        if not (self.armed and self.landed and self.mode.is_guided and is_climb):
            return False
        if self.mode is Mode.GUIDED:
            self.control.guided.take_off(height_m, self.sensed)
        return True

    def set_mode(self, mode: Mode) -> bool:
        """Change the flight mode, or send the refusal as a text. Return True if in the mode
        afterwards.

        A mode that needs a position is refused only while armed; otherwise arming is refused.
        """
        if mode is self.mode:
            return True
        refusal = None
        if mode.manual_throttle and self.radio_failsafe.active:
            refusal = "in RC failsafe"
        elif mode.needs_position and self.armed and not self.position_ready:
            refusal = "requires position"
        if refusal is not None:
            self.send_text(Severity.WARNING, f"Mode change to {mode.name} failed: {refusal}")
            return False
        self.mode = mode
        self.control.enter(mode, self.sensed)
        return True

    def _read_inputs(self) -> None:
        changed = self.radio_failsafe.update(
            new_input=self.rc.update(self.now_ns),
            can_fail=self.rc.found or self.armed,
            now_ns=self.now_ns,
        )
        if changed and self.radio_failsafe.active:
            self._fail_over()
        elif changed:
            self.send_text(Severity.WARNING, "Radio Failsafe Cleared")

    def _start_in_air(self) -> None:
        """Fly on in ALT_HOLD, or in a mode flown by setpoints. An idle receiver commands a
        descent."""
        self.armed = True
        self._set_landed(landed=False)
        if not self.mode.is_guided:
            self.mode = Mode.ALT_HOLD
        self._idle_since_ns = self.now_ns
        self.control.enter(self.mode, self.sensed)

    def _motors(self) -> tuple[float, ...]:
        if not self.armed:
            self.control.reset(self.sensed)
            return STOPPED
        sticks = read_sticks(self.rc, self.params)
        if self.landed:
            if not self._lifts_off(sticks):
                if self.mode.lands or self._is_idle(sticks):
                    self.disarm(force=False)
                return self.control.idle(self.sensed)
            self._set_landed(landed=False)
        self._idle_since_ns = self.now_ns
        return self.control.fly(
            self.mode, sticks, self.sensed, self.now_ns, has_position=self.position_ready
        )

    def _lifts_off(self, sticks: Sticks) -> bool:
        if self.mode.is_guided:
            return self.control.guided.lifts_off(self.now_ns, self._armed_ns)
        return self.control.wants_takeoff(self.mode, sticks)

    def _is_idle(self, sticks: Sticks) -> bool:
        """True after DISARM_DELAY on the ground with the throttle at the bottom, not centred."""
        if not (self.rc.found and sticks.throttle == 0.0):
            self._idle_since_ns = self.now_ns
        delay_s = self.params["DISARM_DELAY"]
        return delay_s > 0.0 and self._has_held(self._idle_since_ns, delay_s * NS_PER_S)

    @property
    def _is_pushing(self) -> bool:
        return self.control.collective > 0.5 * self.params["MOT_THST_HOVER"]

    def _fail_over(self) -> None:
        """Land, brake or return as the parameters say; the mode stays after the cause has gone."""
        if self.armed and self.landed:
            self.send_text(Severity.WARNING, "Radio Failsafe - Disarming")
            self.disarm(force=True)
            return
        options = self.params.integer("FS_OPTIONS")
        if self.armed and self.mode is Mode.LAND and options & FS_OPTION_LANDING_CONTINUES:
            self.send_text(Severity.WARNING, "Radio Failsafe - Continuing Landing")
            return
        if self.armed and self.mode.is_guided and options & FS_OPTION_GUIDED:
            self.send_text(Severity.WARNING, "Radio Failsafe - Continuing Guided Mode")
            return
        self.send_text(Severity.WARNING, "Radio Failsafe")
        if not self.armed:
            return
        mode = FAILSAFE_MODES.get(self.params.integer("FS_THR_ENABLE"), Mode.RTL)
        before = self.mode
        self.set_mode(mode if self.position_ready else Mode.LAND)
        if self.mode is Mode.LAND is not before:
            self.control.sinks_from_ns = self.now_ns + LAND_DELAY_NS
