"""The flight controller without its link: sticks and setpoints in, physics out, 4 ms at a time.

It behaves as a pilot and a companion computer see PX4. Nothing here knows about MAVLink's links,
sockets or the host's time.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from enum import Enum

from sitl.clock import NS_PER_MS, NS_PER_S
from sitl.firmware import StatusText
from sitl.px4.commander import Commander
from sitl.px4.control import SIH_QUAD
from sitl.px4.flight import STOPPED, FlightControl
from sitl.px4.modes import Mode
from sitl.px4.params import Params
from sitl.px4.setpoints import Setpoint
from sitl.px4.sticks import RC_SOURCE, StickInput, Sticks
from sitl.rotation import Quat, Vec3
from sitl.vehicle.conditions import Conditions
from sitl.vehicle.config import Battery, VehicleConfig
from sitl.vehicle.dynamics import BodyState, Quadrotor
from sitl.vehicle.environment import SensorNoise, Wind

STEP_NS = 4 * NS_PER_MS
"""SIH's: every stamp is a multiple of it."""
STEP_S = STEP_NS / NS_PER_S
SUBSTEPS = STEP_NS // SIH_QUAD.step_ns
GPS_PERIOD_NS = NS_PER_S // 8
RECEIVER_PERIOD_NS = NS_PER_S // 50
RECEIVER_LOST_NS = NS_PER_S // 2
LANDED_AFTER_NS = NS_PER_S
LANDED_SPEED_MPS = 0.3
RAMP_FROM_MPS = -2.4  # as long on the ground as measured
TAKEOFF_MARGIN_M = 0.2  # below its height AUTO.TAKEOFF has arrived


RATE_NOISE_RADPS = math.radians(5.0)
"""What SIH's body rates carry, on each axis."""


class LandedState(Enum):
    """MAV_LANDED_STATE of EXTENDED_SYS_STATE."""

    ON_GROUND = 1
    IN_AIR = 2
    TAKEOFF = 3
    LANDING = 4


def _with_gyro_noise(conditions: Conditions) -> Conditions:
    noise = math.hypot(conditions.rate_noise_radps, RATE_NOISE_RADPS)
    return replace(conditions, rate_noise_radps=noise)


class Autopilot:
    """One boot of the vehicle; stamps are nanoseconds of the caller's clock, from ``boot_ns``."""

    def __init__(self, params: Params, config: VehicleConfig, boot_ns: int) -> None:
        self.params = params
        self.config = config
        self.boot_ns = boot_ns
        self.now_ns = boot_ns
        self.landed = True
        self.battery = Battery(voltage_v=16.2)
        """Replaced as a whole by whoever wants another one."""
        self.sensors_frozen = False
        """Fault: telemetry and control keep the last state, the physics goes on."""
        self.position_lost = False
        """Fault: the estimator has no horizontal position any more, as long as this is set."""
        self.stick_input = StickInput(params)
        self.commander = Commander(params, self.stick_input, boot_ns)
        self.motor_commands: tuple[float, ...] = STOPPED
        self.receiver_us: tuple[int, ...] | None = config.receiver_us if config.receiver else None
        """Channels of the receiver, or of RC_CHANNELS_OVERRIDE, which counts as one."""
        self.setpoint: Setpoint | None = None
        self.setpoint_count = 0
        self.flight = FlightControl(params)
        self._setpoint_ns = boot_ns
        self._has_transmitter = config.receiver
        self._receiver_due_ns = boot_ns
        self._quad = Quadrotor(config.conditions, SIH_QUAD)
        self._wind = Wind(config.conditions, STEP_S)
        self._noise = SensorNoise(_with_gyro_noise(config.conditions))
        self._physics = self._quad.at_rest()
        self.sensed = self.gps = self._physics.body
        self._gps_due_ns = boot_ns
        self._still_since_ns: int | None = boot_ns
        self._ramp_ns: int | None = None  # since when the vehicle leaves the ground
        self._flown_mode = self.mode

    @property
    def step_ns(self) -> int:
        """Control period: 250 Hz."""
        return STEP_NS

    @property
    def mode(self) -> Mode:
        """The mode that flies."""
        return self.commander.mode

    @property
    def mode_name(self) -> str:
        """Its name: ALTCTL, AUTO.RTL."""
        return self.mode.label

    @property
    def armed(self) -> bool:
        """The motors may turn."""
        return self.commander.armed

    @property
    def texts(self) -> list[StatusText]:
        """Texts that every link is to send next."""
        return self.commander.texts

    @property
    def in_failsafe(self) -> bool:
        """A failsafe has changed the mode."""
        return self.commander.in_failsafe

    @property
    def truth(self) -> BodyState:
        """True state of the vehicle, without sensor faults and noise."""
        return self._physics.body

    @property
    def sticks_us(self) -> tuple[int, int, int, int]:
        """The chosen sticks as ArduCopter would have them: less is left, nose down, descent."""
        if not self.stick_input.count:
            return (0, 0, 0, 0)
        sticks = self.stick_input.sticks
        axes = (sticks.right, -sticks.forward, sticks.throttle, sticks.yaw)
        roll, pitch, throttle, yaw = (1500 + round(500.0 * value) for value in axes)
        return roll, pitch, throttle, yaw

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
        """True once there is a horizontal position."""
        is_settled = self.uptime_ns >= self.config.position_ready_s * NS_PER_S
        return is_settled and not self.position_lost

    @property
    def landed_state(self) -> LandedState:
        """What EXTENDED_SYS_STATE says."""
        if self.landed:
            return LandedState.ON_GROUND
        if self.mode is Mode.AUTO_LAND:
            return LandedState.LANDING
        return LandedState.TAKEOFF if self.mode is Mode.AUTO_TAKEOFF else LandedState.IN_AIR

    def set_receiver(self, values_us: Sequence[int]) -> None:
        """Move the transmitter's sticks, in microseconds by channel; all zeros switch it off."""
        self._has_transmitter = any(values_us)
        if self._has_transmitter:
            self.receiver_us = tuple(values_us)

    def set_setpoint(self, setpoint: Setpoint, now_ns: int) -> None:
        """Take a setpoint for OFFBOARD; which modes fly by it is the commander's."""
        self.setpoint, self._setpoint_ns = setpoint, now_ns
        self.setpoint_count += 1
        self.commander.setpoint_fresh = True

    def prepare_takeoff(self, height_m: float | None) -> None:
        """Set AUTO.TAKEOFF's height above home; None: MIS_TAKEOFF_ALT above here."""
        above_m = self.params["MIS_TAKEOFF_ALT"] - self.sensed.position_ned_m[2]
        self.flight.takeoff_to_m = above_m if height_m is None else height_m

    def step(self) -> None:
        """Advance everything by one control period."""
        self.now_ns += STEP_NS
        self._read_receiver()
        self.stick_input.update(self.now_ns)
        self._update_commander()
        self.motor_commands = self._motors()
        wind_mps = self._wind.step()
        self._physics = self._quad.step(self._physics, self.motor_commands, SUBSTEPS, wind_mps)
        if not self.sensors_frozen:
            self.sensed = self._noise.sense(self._physics.body)
            if self.now_ns >= self._gps_due_ns:
                self._gps_due_ns += GPS_PERIOD_NS
                self.gps = self.sensed
        self._detect_landing()

    def launch(
        self, position_ned_m: Vec3, velocity_ned_mps: Vec3, ned_from_body_wxyz: Quat
    ) -> None:
        """Put the vehicle in the air in this state, armed; in ALTCTL, unless setpoints fly it.

        Sticks that are valid go on, as do setpoints; else they count as valid and centred until the
        first ones come.
        """
        self._physics = self._quad.airborne(position_ned_m, velocity_ned_mps, ned_from_body_wxyz)
        self.sensed = self.gps = self._physics.body
        commander = self.commander
        if commander.mode is not Mode.OFFBOARD:
            if not self.stick_input.valid:
                self.stick_input.pretend_centred(self.now_ns)
            commander.mode = commander.intended = self._flown_mode = Mode.ALTCTL
            commander.start(ignores_sticks=False)
        self._set_landed(landed=False)
        commander.texts.clear()
        commander.events.clear()
        self._still_since_ns = None
        self.flight.reset(self.sensed)

    def _read_receiver(self) -> None:
        """The receiver's four mapped channels are a source of sticks like any link."""
        if self.receiver_us is None or not self._has_transmitter:
            return
        if self.now_ns < self._receiver_due_ns:
            return
        self._receiver_due_ns = self.now_ns + RECEIVER_PERIOD_NS
        channels = [
            self.params.integer(f"RC_MAP_{axis}") for axis in ("PITCH", "ROLL", "THROTTLE", "YAW")
        ]
        if all(1 <= channel <= len(self.receiver_us) for channel in channels):
            values = [(self.receiver_us[channel - 1] - 1500) / 500.0 for channel in channels]
            pitch, roll, throttle, yaw = (max(-1.0, min(1.0, value)) for value in values)
            sticks = Sticks(forward=-pitch, right=roll, throttle=throttle, yaw=yaw)
            self.stick_input.on_sticks(RC_SOURCE, sticks, self.now_ns)

    def _update_commander(self) -> None:
        commander = self.commander
        commander.estimator_ready = self.estimator_ready
        commander.position_ready = self.position_ready
        age_ns = self.now_ns - self._setpoint_ns
        if self.setpoint is not None and age_ns >= self.params["COM_OF_LOSS_T"] * NS_PER_S:
            commander.setpoint_fresh = False
        commander.update(self.now_ns)

    def _motors(self) -> tuple[float, ...]:
        if not self.armed or self.commander.terminated:
            return STOPPED
        if self.mode is not self._flown_mode:
            self._flown_mode = self.mode
            self.flight.reset(self.sensed)
        if not self._leaves_ground():
            return self.flight.idle(self.sensed)
        commands = self.flight.fly(
            self.mode,
            self.stick_input.sticks,
            self.setpoint,
            self.sensed,
            has_position=self.position_ready,
            dt_s=STEP_S,
        )
        height_m = -self.sensed.position_ned_m[2]
        if height_m >= self.flight.takeoff_to_m - TAKEOFF_MARGIN_M:
            self.commander.finish_takeoff()
        return commands

    def _leaves_ground(self) -> bool:
        """True in flight, and once a landed vehicle is to lift off.

        Where it climbs at a rate, the most that it may climb at grows over MPC_TKO_RAMP_T, from a
        value below zero: the motors spin up before the vehicle moves.
        """
        if self._ramp_ns is not None:
            share = (
                (self.now_ns - self._ramp_ns) / NS_PER_S / max(0.1, self.params["MPC_TKO_RAMP_T"])
            )
            up_mps = self.params["MPC_Z_VEL_MAX_UP"]
            self.flight.most_climb_mps = RAMP_FROM_MPS + share * (up_mps - RAMP_FROM_MPS)
            if share >= 1.0:
                self.flight.most_climb_mps, self._ramp_ns = math.inf, None
        if not self.landed:
            return True
        armed_ns = self.now_ns - self.commander.armed_ns
        sticks = self.stick_input.sticks
        if armed_ns < self.params["COM_SPOOLUP_TIME"] * NS_PER_S or not self.flight.wants_takeoff(
            self.mode, sticks, self.setpoint, self.sensed
        ):
            self._ramp_ns, self.flight.most_climb_mps = None, math.inf
            return False
        if not self.flight.is_direct(self.mode, self.setpoint):
            self._ramp_ns = self.now_ns if self._ramp_ns is None else self._ramp_ns
            if self.flight.most_climb_mps <= 0.0 or math.isinf(self.flight.most_climb_mps):
                return False
        self._set_landed(landed=False)
        self._still_since_ns = None
        return True

    def _set_landed(self, *, landed: bool) -> None:
        self.landed = landed
        self.commander.on_landed_change(landed=landed)

    def _detect_landing(self) -> None:
        body = self.sensed
        is_slow = max(abs(v) for v in body.velocity_ned_mps) < LANDED_SPEED_MPS
        is_pushing = self.armed and self.flight.thrust > 0.5 * self.params["MPC_THR_HOVER"]
        if not (body.touching and is_slow and not is_pushing):
            self._still_since_ns = None
        elif self._still_since_ns is None:
            self._still_since_ns = self.now_ns
        elif not self.landed and self.now_ns - self._still_since_ns >= LANDED_AFTER_NS:
            self._set_landed(landed=True)
