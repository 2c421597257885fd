"""Velocities by SET_POSITION_TARGET_LOCAL_NED, with their echo in POSITION_TARGET_LOCAL_NED."""

import math

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.clock import NS_PER_S
from mavbridge.core.vehicle import Action, ActionMeaning, Output, Velocity
from mavbridge.mavlink.codec.messages import Body, VelocityTarget
from mavbridge.mavlink.codec.packets import Codec, CommandRefusedError
from mavbridge.mavlink.outputs.echo import EchoRules
from mavbridge.mavlink.outputs.output import Encoded
from mavbridge.mavlink.outputs.setpoints import FOREIGN_SAMPLES, SetpointOutput
from mavbridge.mavlink.session.vehicle import VehicleSession

MM_PER_M = 1000
VELOCITY_ECHO = EchoRules(
    tolerance=0, dithered=0, dither=1, seek_dither=1, centre=0, foreign_samples=FOREIGN_SAMPLES
)
"""Velocity down, in mm/s, which both autopilots show as it was sent; the horizontal ones are turned
into NED axes first."""


class VelocityOutput(SetpointOutput):
    """SET_POSITION_TARGET_LOCAL_NED with a velocity and a yaw rate."""

    name: Output = "velocity"
    takeoff_ns = 3 * NS_PER_S
    """PX4 brings the climb in over MPC_TKO_RAMP_T, 3 s by default, and shows that: the speed down
    went from +2.2 to the -1.5 m/s that were sent in 2.0 s, of which 0.8 on the ground."""
    _echo_message = "POSITION_TARGET_LOCAL_NED"

    def __init__(self, codec: Codec, meaning: ActionMeaning) -> None:
        super().__init__(codec, VELOCITY_ECHO)
        self._is_heading_frame = meaning.is_heading_frame

    def encode(self, action: Action, vehicle: VehicleSession, now_ns: int) -> Encoded | None:
        """The setpoint, within the climb rates that the vehicle would itself limit it to."""
        if not isinstance(action, Velocity):
            raise CommandRefusedError(f"{type(action).__name__} is no velocity")
        if not all(map(math.isfinite, action)):
            raise CommandRefusedError(f"{action} is not finite")
        climb_mps, descent_mps = vehicle.profile.climb_limits(vehicle.known_params)
        down_mps = min(max(action.z_mps, -climb_mps), descent_mps)
        shown = self.echo.with_dither((round(down_mps * MM_PER_M),), now_ns)
        sent = action._replace(z_mps=shown[0] / MM_PER_M)
        packet = self._codec.encode_velocity(
            vehicle.identity.source, sent, is_heading_frame=self._is_heading_frame, now_ns=now_ns
        )
        return Encoded(packet, sent, shown)

    def encode_resting(self, action: Action, vehicle: VehicleSession, now_ns: int) -> bytes | None:
        """See `ActionOutput`."""
        if not isinstance(action, Velocity):
            return None
        return self._codec.encode_velocity(
            vehicle.identity.source, action, is_heading_frame=self._is_heading_frame, now_ns=now_ns
        )

    def _compare(self, body: Body | None, vehicle: VehicleSession, arrived_ns: int) -> None:
        """Compare the velocity down, if the target has one (a takeoff has a position)."""
        if not isinstance(body, VelocityTarget):
            return
        if not body.type_mask & dialect.POSITION_TARGET_TYPEMASK_VZ_IGNORE:
            shown = (round(body.velocity_ned_mps[2] * MM_PER_M),)
            self.echo.received(shown, arrived_ns // 1000, arrived_ns)
