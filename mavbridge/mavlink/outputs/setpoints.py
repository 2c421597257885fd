"""Outputs for setpoints: common base, and velocities by SET_POSITION_TARGET_LOCAL_NED."""

import math
from typing import ClassVar

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.clock import NS_PER_S
from mavbridge.core.vehicle import Action, ActionMeaning, Output, Velocity
from mavbridge.mavlink.codec.messages import Body, VelocityTarget
from mavbridge.mavlink.codec.packets import Codec, CommandRefusedError
from mavbridge.mavlink.outputs.echo import EchoRules, Shown
from mavbridge.mavlink.outputs.output import ActionOutput, Encoded
from mavbridge.mavlink.session.vehicle import VehicleSession

HELD_NS = 3 * NS_PER_S
"""Longest time for which a vehicle follows the last setpoint: ArduPilot's default GUID_TIMEOUT;
PX4's COM_OF_LOSS_T is 1 s."""
FOREIGN_SAMPLES = 5
"""Foreign samples that count as a fault. A new mode shows its own targets at once and its name
within 30 ms; five samples take 50 to 100 ms, so that a mode change is reported as one."""


class SetpointOutput(ActionOutput):
    """Setpoints, whose release is silence: only a mode change takes the vehicle from the last one.

    The output repeats nothing by itself.

    The echo is checked while the vehicle is armed, in the air and in a mode that follows setpoints;
    in other states a different target is normal.
    """

    is_sticks = False
    releases = 0
    takeoff_ns: ClassVar[int] = 0
    """Time after leaving the ground for which another target is normal."""

    def __init__(self, codec: Codec, rules: EchoRules) -> None:
        super().__init__(codec, rules)
        self._sent_ns: int | None = None
        self._ground_ns: int | None = None
        """Last time on the ground that was seen while sending."""
        self._is_checked = False

    def restart(self) -> None:
        """Start a new session, in which nothing was sent."""
        super().restart()
        self._sent_ns, self._ground_ns, self._is_checked = None, None, False

    def _follows(self, vehicle: VehicleSession, now_ns: int) -> bool:
        """True if the vehicle is armed and in a mode that follows setpoints."""
        status = vehicle.status(now_ns)
        roles = vehicle.profile.modes.roles
        return status is not None and status.armed and status.mode in roles.setpoint

    def _expected(self, shown: Shown, vehicle: VehicleSession, now_ns: int) -> Shown | None:
        """Return the echo to expect; None in other modes, on the ground and just above it."""
        status = vehicle.status(now_ns)
        if status is not None and status.is_landed is True:
            self._ground_ns = now_ns
        is_low = self._ground_ns is not None and now_ns - self._ground_ns <= self.takeoff_ns
        return shown if self._follows(vehicle, now_ns) and not is_low else None

    def sent(self, encoded: Encoded, now_ns: int) -> None:
        """Note an action that was sent, and expect its echo if it has one."""
        self._sent_ns = now_ns
        self._is_checked = encoded.shown is not None
        super().sent(encoded, now_ns)
        if not self._is_checked:
            super().released()

    def released(self) -> None:
        """Note the end of sending."""
        super().released()
        self._is_checked = False

    def is_released(self, vehicle: VehicleSession, now_ns: int) -> bool:
        """True if another mode has taken over, or the vehicle's own setpoint timeout has passed."""
        if self._sent_ns is None:
            return True
        is_over = now_ns - self._sent_ns > HELD_NS
        return not self.echo.is_sending and (is_over or not self._follows(vehicle, now_ns))


MM_PER_M = 1000
VELOCITY_ECHO = EchoRules(
    tolerance=0, dithered=0, dither=1, seek_dither=1, centre=0, foreign_samples=FOREIGN_SAMPLES
)
"""Velocity down [mm/s], which both autopilots echo as sent; they rotate horizontal velocities into
NED axes first."""


class VelocityOutput(SetpointOutput):
    """SET_POSITION_TARGET_LOCAL_NED with a velocity and a yaw rate."""

    name: Output = "velocity"
    takeoff_ns = 3 * NS_PER_S
    """PX4 ramps the climb over MPC_TKO_RAMP_T, 3 s by default, and echoes the ramp: the down speed
    went from +2.2 to the commanded -1.5 m/s in 2.0 s, 0.8 s of that on the ground."""
    _echo_message = "POSITION_TARGET_LOCAL_NED"

    def __init__(self, codec: Codec, meaning: ActionMeaning) -> None:
        super().__init__(codec, VELOCITY_ECHO)
        self._is_heading_frame = meaning.is_heading_frame

    def encode(self, action: Action, vehicle: VehicleSession, now_ns: int) -> Encoded | None:
        """Encode the setpoint, clipped to the vehicle's own climb and descent limits."""
        if not isinstance(action, Velocity):
            raise CommandRefusedError(f"{type(action).__name__} is no velocity")
        if not all(map(math.isfinite, action)):
            raise CommandRefusedError(f"{action} is not finite")
        climb_mps, descent_mps = vehicle.params.traits.climb_limits_mps
        down_mps = min(max(action.z_mps, -climb_mps), descent_mps)
        shown = self.echo.with_dither((round(down_mps * MM_PER_M),), now_ns)
        sent = action._replace(z_mps=shown[0] / MM_PER_M)
        packet = self._codec.encode_velocity(
            vehicle.identity.source, sent, is_heading_frame=self._is_heading_frame, now_ns=now_ns
        )
        return Encoded(packet, sent, self._expected(shown, vehicle, now_ns))

    def _compare(self, body: Body | None, vehicle: VehicleSession, arrived_ns: int) -> None:
        """Compare the down velocity, if the target has one (a takeoff has a position)."""
        if not isinstance(body, VelocityTarget):
            return
        if not body.type_mask & dialect.POSITION_TARGET_TYPEMASK_VZ_IGNORE:
            shown = (round(body.velocity_ned_mps[2] * MM_PER_M),)
            self.echo.received(shown, arrived_ns // 1000, arrived_ns)
