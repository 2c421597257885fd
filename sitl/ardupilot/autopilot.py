"""The flight controller without its link: sticks in, physics out, one step of 2.5 ms at a time.

It behaves as a pilot and a companion computer see ArduCopter: modes, arming, failsafes, and their
status texts, word for word. Nothing here knows about MAVLink, sockets or the host's time.
"""

from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

from sitl.ardupilot.failsafe import GcsFailsafe, RadioFailsafe
from sitl.ardupilot.flight_modes import STOPPED, FlightControl, Mode
from sitl.ardupilot.params import Params
from sitl.ardupilot.rc import IDLE_RECEIVER_US, ModeSwitch, RcEngine
from sitl.ardupilot.sticks import climb_rate_mps, read_sticks
from sitl.clock import NS_PER_S
from sitl.rotation import Quat, Vec3, cos_tilt
from sitl.vehicle.conditions import NOMINAL, Conditions
from sitl.vehicle.dynamics import PHYSICS_STEP_NS, BodyState, Quadrotor
from sitl.vehicle.environment import SensorNoise, Wind

SUBSTEPS = 2
STEP_NS = SUBSTEPS * PHYSICS_STEP_NS
STEP_S = STEP_NS / NS_PER_S
GPS_PERIOD_NS = NS_PER_S // 5

LANDED_AFTER_NS = NS_PER_S
LANDED_SPEED_MPS = 0.3
CRASH_TILT_COS = 0.7
CRASH_AFTER_NS = NS_PER_S
SEVERITY_CRITICAL, SEVERITY_WARNING, SEVERITY_INFO = 2, 4, 6

FAILSAFE_MODES = {
    "FS_THR_ENABLE": {3: Mode.LAND, 7: Mode.BRAKE},
    "FS_GCS_ENABLE": {5: Mode.LAND, 7: Mode.BRAKE},
}
"""The mode that each value of the parameter selects; any other value but 0 means RTL."""
FS_OPTION_LANDING_CONTINUES = 8
FS_OPTION_PILOT_CONTINUES = 16
RC_OPTION_SKIP_NEUTRAL_CHECK = 64


class StatusText(NamedTuple):
    """STATUSTEXT for the ground station, with MAVLink's severity."""

    severity: int
    text: str


class Battery(NamedTuple):
    """The vehicle's word about its battery; it never empties by itself."""

    voltage_v: float = 12.6
    current_a: float = 0.0
    remaining_percent: int = 100
    is_low: bool = False
    """ArduCopter's battery failsafe has fired; this vehicle reports it and flies on."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleConfig:
    """Differences between one simulated vehicle and another."""

    receiver: bool = True
    """An RC receiver is there; without one the sticks latch and the radio fails."""
    receiver_us: tuple[int, ...] = IDLE_RECEIVER_US
    """The receiver's channels at boot, in microseconds."""
    vehicle_type: int = 2
    """HEARTBEAT.type, a MAV_TYPE: 2 is a quadrotor, and flies as one whatever it says."""
    estimator_ready_s: float = 3.0
    """From boot until arming is possible (about 23 s on the real firmware)."""
    position_ready_s: float = 5.0
    """From boot until the estimator has a position (about 40 s on the real firmware)."""
    conditions: Conditions = NOMINAL
    """Airframe, air and sensors; `sitl.camera.fpv.FpvRenderer` takes those of the camera."""


class Autopilot:
    """One boot of the vehicle; stamps are nanoseconds of the caller's clock, from ``boot_ns``."""

    def __init__(self, params: Params, config: VehicleConfig, boot_ns: int) -> None:
        self.params = params
        self.config = config
        self.boot_ns = boot_ns
        self.now_ns = boot_ns
        self.mode = Mode.STABILIZE
        self.armed = False
        self.landed = True
        self.rc = RcEngine(params, config.receiver_us if config.receiver else None)
        self.battery = Battery()
        """Replaced as a whole by whoever wants another one."""
        self.radio_failsafe = RadioFailsafe(params, boot_ns)
        self.gcs_failsafe = GcsFailsafe(params)
        self.texts: list[StatusText] = []
        """Status texts to send; the reader empties the list."""
        self.motor_commands: tuple[float, ...] = STOPPED
        self.sensors_frozen = False
        """Fault: telemetry and control keep the last state, the physics goes on."""
        self.position_lost = False
        """Fault: the estimator has no position any more, as long as this is set."""
        self._control = FlightControl(params)
        self._mode_switch = ModeSwitch()
        self._quad = Quadrotor(config.conditions)
        self._wind = Wind(config.conditions, STEP_S)
        self._noise = SensorNoise(config.conditions)
        self._physics = self._quad.at_rest()
        self.sensed = self._physics.body
        self.gps = self._physics.body
        """State at the last 5 Hz fix."""
        self._gps_due_ns = boot_ns
        self._still_since_ns: int | None = boot_ns
        self._tipped_since_ns: int | None = None
        self._idle_since_ns = boot_ns

    @property
    def truth(self) -> BodyState:
        """True state of the vehicle, without sensor faults and noise."""
        return self._physics.body

    @property
    def uptime_ns(self) -> int:
        """Time since boot: the clock of all telemetry."""
        return self.now_ns - self.boot_ns

    @property
    def estimator_ready(self) -> bool:
        """True once the attitude is aligned: arming is possible."""
        return self.uptime_ns >= self.config.estimator_ready_s * NS_PER_S

    @property
    def position_ready(self) -> bool:
        """True once there is a position: LOCAL_POSITION_NED flows, RTL is possible."""
        is_settled = self.uptime_ns >= self.config.position_ready_s * NS_PER_S
        return is_settled and not self.position_lost

    def prearm_refusal(self) -> str | None:
        """ArduCopter's reason why the vehicle is not ready to arm in any mode (PREARM_CHECK)."""
        if not self.estimator_ready:
            return "AHRS: EKF3 not started"
        if not self.rc.found:
            return "RC not found"
        if self.radio_failsafe.active:
            return "Radio failsafe on"
        throttle_us = self.rc.channels_us[self.rc.index_of("THROTTLE")]
        if self.params["FS_THR_ENABLE"] and throttle_us < self.params["FS_THR_VALUE"]:
            return "Throttle below failsafe"
        return None

    def _stick_refusal(self) -> str | None:
        """ArduCopter's reason why mode or sticks forbid arming, or None."""
        if not self.mode.piloted:
            return f"{self.mode.name} mode not armable"
        if self.mode.needs_position and not self.position_ready:
            return "Need Position Estimate"
        sticks = read_sticks(self.rc, self.params)
        is_thrust = self.mode.manual_throttle and sticks.throttle > 0
        if is_thrust or climb_rate_mps(sticks, self.params) > 0.0:
            return "Throttle too high"
        if self.params.integer("RC_OPTIONS") & RC_OPTION_SKIP_NEUTRAL_CHECK:
            return None
        for axis, value in (("Roll", sticks.roll), ("Pitch", sticks.pitch), ("Yaw", sticks.yaw)):
            if value != 0.0:
                return f"{axis} (RC{self.rc.index_of(axis.upper()) + 1}) is not neutral"
        return None

    def arm(self, *, force: bool) -> bool:
        """Start the motors; a refusal becomes a status text. True if armed afterwards."""
        if self.armed:
            return True
        refusal = self.prearm_refusal() or self._stick_refusal()
        if refusal is not None and not force:
            self._send_text(SEVERITY_CRITICAL, f"Arm: {refusal}")
            return False
        self.armed = True
        self._idle_since_ns = self.now_ns
        self._control.reset(self.sensed)
        self._send_text(SEVERITY_INFO, "Arming motors")
        return True

    def disarm(self, *, force: bool) -> bool:
        """Stop the motors; refused in flight unless forced. True if disarmed afterwards."""
        if self.armed and not (self.landed or force):
            return False
        if self.armed:
            self.armed = False
            self._send_text(SEVERITY_INFO, "Disarming motors")
        return True

    def set_mode(self, mode: Mode) -> bool:
        """Change the flight mode; a refusal becomes a status text. True if in that mode then.

        A mode that needs a position is refused in the air only: on the ground arming is.
        """
        if mode is self.mode:
            return True
        refusal = None
        if mode.manual_throttle and self.radio_failsafe.active:
            refusal = "in RC failsafe"
        elif mode.needs_position and self.armed and not self.position_ready:
            refusal = "requires position"
        if refusal is not None:
            self._send_text(SEVERITY_WARNING, f"Mode change to {mode.name} failed: {refusal}")
            return False
        self.mode = mode
        self._control.reset(self.sensed)
        return True

    def step(self) -> None:
        """Advance everything by one control period."""
        self.now_ns += STEP_NS
        self._read_radio()
        if self.gcs_failsafe.update(self.now_ns):
            self._on_gcs_change()
        self.motor_commands = self._motors()
        wind_mps = self._wind.step()
        self._physics = self._quad.step(self._physics, self.motor_commands, SUBSTEPS, wind_mps)
        if not self.sensors_frozen:
            self.sensed = self._noise.sense(self._physics.body)
            if self.now_ns >= self._gps_due_ns:
                self._gps_due_ns += GPS_PERIOD_NS
                self.gps = self.sensed
        self._detect_landing()
        self._detect_crash()

    def launch(
        self, position_ned_m: Vec3, velocity_ned_mps: Vec3, ned_from_body_wxyz: Quat
    ) -> None:
        """Put the vehicle in the air in this state, armed and in ALT_HOLD.

        The sticks count from the next step: an idle receiver commands a descent.
        """
        self._physics = self._quad.airborne(position_ned_m, velocity_ned_mps, ned_from_body_wxyz)
        self.sensed = self.gps = self._physics.body
        self.armed = True
        self.landed = False
        self.mode = Mode.ALT_HOLD
        self._idle_since_ns = self.now_ns
        self._still_since_ns = self._tipped_since_ns = None
        self._control.reset(self.sensed)

    def _motors(self) -> tuple[float, ...]:
        if not self.armed:
            return STOPPED
        sticks = read_sticks(self.rc, self.params)
        if self.landed:
            if not self._control.wants_takeoff(self.mode, sticks):
                # LAND and RTL stop the motors on touchdown, the other modes after DISARM_DELAY.
                delay_s = self.params["DISARM_DELAY"]
                is_idle = delay_s > 0.0 and self._has_held(self._idle_since_ns, delay_s * NS_PER_S)
                if is_idle or self.mode.lands:
                    self.disarm(force=False)
                return self._control.idle(self.sensed)
            self.landed = False
            self._still_since_ns = None
        self._idle_since_ns = self.now_ns
        return self._control.fly(
            self.mode, sticks, self.sensed, has_position=self.position_ready, dt_s=STEP_S
        )

    def _detect_landing(self) -> None:
        body = self.sensed
        is_slow = max(abs(v) for v in body.velocity_ned_mps) < LANDED_SPEED_MPS
        is_pushing = self.armed and self._control.collective > 0.5 * self.params["MOT_THST_HOVER"]
        is_still = body.touching and is_slow and not is_pushing
        self._still_since_ns = self._since(self._still_since_ns, is_still)
        if self._has_held(self._still_since_ns, LANDED_AFTER_NS):
            self.landed = True

    def _detect_crash(self) -> None:
        """Stop the motors of a vehicle that lies on its side."""
        is_tilted = cos_tilt(self.sensed.ned_from_body_wxyz) < CRASH_TILT_COS
        is_tipped = self.armed and self.sensed.touching and is_tilted
        self._tipped_since_ns = self._since(self._tipped_since_ns, is_tipped)
        if self._has_held(self._tipped_since_ns, CRASH_AFTER_NS):
            self._send_text(SEVERITY_CRITICAL, "Crash: Disarming")
            self.disarm(force=True)

    def _since(self, since_ns: int | None, condition: bool) -> int | None:
        """Start of the time for which the condition has held; None if it does not hold."""
        if not condition:
            return None
        return self.now_ns if since_ns is None else since_ns

    def _has_held(self, since_ns: int | None, duration_ns: float) -> bool:
        return since_ns is not None and self.now_ns - since_ns >= duration_ns

    def _read_radio(self) -> None:
        new_input = self.rc.update(self.now_ns)
        self._read_mode_switch()
        changed = self.radio_failsafe.update(
            new_input=new_input,
            throttle_us=self.rc.channels_us[self.rc.index_of("THROTTLE")],
            can_fail=self.rc.has_receiver or self.armed,
            now_ns=self.now_ns,
        )
        if not changed:
            return
        if self.radio_failsafe.active:
            self._fail_over("Radio", "FS_THR_ENABLE")
        else:
            self._send_text(SEVERITY_WARNING, "Radio Failsafe Cleared")

    def _read_mode_switch(self) -> None:
        channel = self.params.integer("FLTMODE_CH")
        if not 1 <= channel <= len(self.rc.channels_us):
            return
        position = self._mode_switch.update(self.rc.channels_us[channel - 1], self.now_ns)
        if position is not None:
            with suppress(ValueError):  # a mode that this vehicle does not have
                self.set_mode(Mode(self.params.integer(f"FLTMODE{position}")))

    def _on_gcs_change(self) -> None:
        if not self.gcs_failsafe.active:
            self._send_text(SEVERITY_WARNING, "GCS Failsafe Cleared")
            return
        self.rc.clear_overrides()
        continues = self.params.integer("FS_OPTIONS") & FS_OPTION_PILOT_CONTINUES
        if self.armed and self.mode.piloted and continues:
            self._send_text(SEVERITY_WARNING, "GCS Failsafe - Continuing Pilot Control")
        else:
            self._fail_over("GCS", "FS_GCS_ENABLE")

    def _fail_over(self, who: str, parameter: str) -> None:
        """Bring the vehicle down or home; the mode stays when the cause has gone."""
        if self.armed and self.landed:
            self._send_text(SEVERITY_WARNING, f"{who} Failsafe - Disarming")
            self.disarm(force=True)
            return
        options = self.params.integer("FS_OPTIONS")
        if self.armed and self.mode is Mode.LAND and options & FS_OPTION_LANDING_CONTINUES:
            self._send_text(SEVERITY_WARNING, f"{who} Failsafe - Continuing Landing")
            return
        self._send_text(SEVERITY_WARNING, f"{who} Failsafe")
        if not self.armed:
            return
        mode = FAILSAFE_MODES[parameter].get(self.params.integer(parameter), Mode.RTL)
        self.set_mode(mode if self.position_ready else Mode.LAND)

    def _send_text(self, severity: int, text: str) -> None:
        self.texts.append(StatusText(severity, text))
