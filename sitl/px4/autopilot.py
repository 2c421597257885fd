"""PX4 without its link: sticks and setpoints in, physics out, in steps of 4 ms.

It behaves as a pilot and a companion computer see PX4. This module knows nothing about MAVLink's
links, sockets or the host's time.
"""

import math

from sitl.clock import NS_PER_S
from sitl.px4.commander import Commander
from sitl.px4.control import SIH_QUAD, STEP_NS
from sitl.px4.flight import Px4Control
from sitl.px4.modes import Px4Mode
from sitl.px4.params import Px4Params
from sitl.px4.sticks import RC_SOURCE, Px4Sticks
from sitl.vehicle.config import VehicleConfig
from sitl.vehicle.firmware import STOPPED, VelocitySetpoint

RESTING_PERIOD_NS = 300 * NS_PER_S // 1000
"""PX4 reads a receiver whose channels do not change only at this period (``rc_update``)."""
RAMP_FROM_MPS = -2.4  # chosen to match the measured time on the ground
TAKEOFF_MARGIN_M = 0.2  # AUTO.TAKEOFF has arrived this far below its height


class Px4(Commander):
    """One boot of PX4, with the control period, airframe and noise of PX4's SIH.

    Every stamp is a multiple of the control period.
    """

    step_ns = STEP_NS
    airframe = SIH_QUAD
    gyro_noise_radps = math.radians(5.0)
    id_param = "MAV_SYS_ID"
    battery_mv = 16_200

    def __init__(self, params: Px4Params, config: VehicleConfig, boot_ns: int) -> None:
        super().__init__(params, config, boot_ns)
        self.flight = Px4Control(params)
        self._read_us: tuple[int, ...] | None = None  # channels at the last reading
        self._read_ns = boot_ns
        self._ramp_ns: int | None = None  # start of the takeoff ramp; None: no ramp
        self._flown_mode = self.mode

    @property
    def sticks_us(self) -> tuple[int, int, int, int]:
        """The chosen sticks with ArduCopter's signs: less is left, nose down and descent."""
        if not self.stick_input.count:
            return (0, 0, 0, 0)
        sticks = self.stick_input.sticks
        axes = (sticks.right, -sticks.forward, sticks.throttle, sticks.yaw)
        roll, pitch, throttle, yaw = (1500 + round(500.0 * value) for value in axes)
        return roll, pitch, throttle, yaw

    def prepare_takeoff(self, height_m: float | None) -> None:
        above_m = self.params["MIS_TAKEOFF_ALT"] - self.sensed.position_ned_m[2]
        self.flight.takeoff_to_m = above_m if height_m is None else height_m

    def _read_inputs(self) -> None:
        self._read_receiver()
        self.stick_input.update(self.now_ns)
        super()._read_inputs()

    def _start_in_air(self) -> None:
        """Fly on in ALTCTL, unless setpoints fly it.

        Valid sticks and setpoints stay in effect. Without valid sticks, centred ones are assumed
        until the first real ones come.
        """
        if self.mode is not Px4Mode.OFFBOARD:
            if not self.stick_input.valid:
                self.stick_input.pretend_centred(self.now_ns)
            self.mode = self.intended = self._flown_mode = Px4Mode.ALTCTL
            self.start_motors(ignores_sticks=False)
        self._set_landed(landed=False)
        self.texts.clear()
        self.events.clear()
        self.flight.reset(self.sensed)

    def _read_receiver(self) -> None:
        """Feed the receiver's four mapped channels to the stick input as one more source."""
        if (frame_us := self.receiver.frame(self.now_ns)) is None:
            return
        if frame_us == self._read_us and self.now_ns - self._read_ns <= RESTING_PERIOD_NS:
            return
        self._read_us, self._read_ns = tuple(frame_us), self.now_ns
        channels = [
            self.params.integer(f"RC_MAP_{axis}") for axis in ("PITCH", "ROLL", "THROTTLE", "YAW")
        ]
        if all(1 <= channel <= len(frame_us) for channel in channels):
            values = [(frame_us[channel - 1] - 1500) / 500.0 for channel in channels]
            pitch, roll, throttle, yaw = (max(-1.0, min(1.0, value)) for value in values)
            sticks = Px4Sticks(forward=-pitch, right=roll, throttle=throttle, yaw=yaw)
            self.stick_input.on_sticks(RC_SOURCE, sticks, self.now_ns)

    def _motors(self) -> tuple[float, ...]:
        if not self.armed:
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
        )
        height_m = -self.sensed.position_ned_m[2]
        is_up = height_m >= self.flight.takeoff_to_m - TAKEOFF_MARGIN_M
        if is_up and self.intended is Px4Mode.AUTO_TAKEOFF:
            self._intend(Px4Mode.AUTO_LOITER)
        return commands

    def _leaves_ground(self) -> bool:
        """True in flight, and once a landed vehicle lifts off.

        In modes with a climb rate its limit ramps up over MPC_TKO_RAMP_T from a negative value, so
        that the motors spin up before the vehicle moves.
        """
        self.flight.most_climb_mps = math.inf
        if self._ramp_ns is not None:
            ramp_s = max(0.1, self.params["MPC_TKO_RAMP_T"])
            share = (self.now_ns - self._ramp_ns) / NS_PER_S / ramp_s
            rise_mps = share * (self.params["MPC_Z_VEL_MAX_UP"] - RAMP_FROM_MPS)
            if share < 1.0:
                self.flight.most_climb_mps = RAMP_FROM_MPS + rise_mps
            else:
                self._ramp_ns = None
        if not self.landed:
            return True
        is_spooled = self.now_ns - self._armed_ns >= self.params["COM_SPOOLUP_TIME"] * NS_PER_S
        if not is_spooled or not self.flight.wants_takeoff(
            self.mode, self.stick_input.sticks, self.setpoint, self.sensed
        ):
            self._ramp_ns, self.flight.most_climb_mps = None, math.inf
            return False
        is_velocity = isinstance(self.setpoint, VelocitySetpoint)
        is_thrust = self.mode is Px4Mode.OFFBOARD and not is_velocity
        if not (self.mode.manual_throttle or is_thrust):
            self._ramp_ns = self.now_ns if self._ramp_ns is None else self._ramp_ns
            if self.flight.most_climb_mps <= 0.0 or math.isinf(self.flight.most_climb_mps):
                return False
        self._set_landed(landed=False)
        return True

    @property
    def _is_pushing(self) -> bool:
        return self.flight.thrust > 0.5 * self.params["MPC_THR_HOVER"]
