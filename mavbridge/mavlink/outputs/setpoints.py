"""Outputs for setpoints: velocities by SET_POSITION_TARGET_LOCAL_NED; attitudes and body rates by
SET_ATTITUDE_TARGET. Each with its echo."""

import math
from typing import ClassVar

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.rotation import heading_rad, quaternion_from_euler, tilt_rad
from mavbridge.core.vehicle import (
    Action,
    ActionMeaning,
    AdviceText,
    AttitudeThrust,
    BodyRates,
    Output,
    Velocity,
)
from mavbridge.mavlink.codec.messages import (
    Attitude,
    AttitudeTarget,
    Body,
    SpecificForce,
    VelocityTarget,
)
from mavbridge.mavlink.codec.packets import Codec, CommandRefusedError
from mavbridge.mavlink.outputs.echo import EchoRules, Shown
from mavbridge.mavlink.outputs.output import ActionOutput, Encoded
from mavbridge.mavlink.profiles.profile import Profile
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
        no_vz = dialect.POSITION_TARGET_TYPEMASK_VZ_IGNORE
        if isinstance(body, VelocityTarget) and not body.type_mask & no_vz:
            shown = (round(body.velocity_ned_mps[2] * MM_PER_M),)
            self.echo.received(shown, arrived_ns // 1000, arrived_ns)


GRAVITY_MPS2 = 9.80665
_TAU_S = 0.5
_ENOUGH_NS = NS_PER_S
_GAP_NS = 200 * NS_PER_MS
_CALM_MPS2 = (7.0, 13.0)
"""Specific force along the body's up axis in calm flight."""
PLAUSIBLE_THRUST = (0.05, 0.9)
"""Plausible range of hover thrust of a multirotor."""


class HoverThrust:
    """Estimate of the hover thrust, from the vehicle's own thrust demand and the specific force.

    The estimate also holds in a climb or descent. Parameters (MOT_THST_HOVER, MPC_THR_HOVER) are
    less accurate: ArduPilot's SITL hovers at 0.364 with 0.39 in the parameter, an error of 0.9 m/s
    of climb after one second.
    """

    def __init__(self) -> None:
        self.value: float | None = None
        """None before one second of calm flight."""
        self._thrust = self._force_mps2 = 0.0
        self._since_ns = self._last_ns = 0
        self._force: tuple[int, float] | None = None

    def receive_force(self, up_mps2: float, now_ns: int) -> None:
        """Add the specific force along the body's up axis [m/s^2]."""
        self._force = (now_ns, up_mps2)

    def receive_thrust(self, thrust: float, now_ns: int) -> None:
        """Add the thrust demand of the vehicle's own controller, in the air and nearly level."""
        if self._force is None or now_ns - self._force[0] > _GAP_NS:
            return
        force_mps2 = self._force[1]
        if now_ns - self._last_ns > _GAP_NS:
            self._since_ns, self._thrust, self._force_mps2 = now_ns, thrust, force_mps2
        weight = min((now_ns - self._last_ns) / NS_PER_S / _TAU_S, 1.0)
        self._thrust += weight * (thrust - self._thrust)
        self._force_mps2 += weight * (force_mps2 - self._force_mps2)
        self._last_ns = now_ns
        is_calm = _CALM_MPS2[0] < self._force_mps2 < _CALM_MPS2[1]
        hover = self._thrust * GRAVITY_MPS2 / self._force_mps2 if is_calm else 0.0
        is_plausible = PLAUSIBLE_THRUST[0] < hover < PLAUSIBLE_THRUST[1]
        if is_plausible and now_ns - self._since_ns >= _ENOUGH_NS:
            self.value = hover


THRUST_UNITS = 1_000_000
THRUST_ECHO = EchoRules(
    tolerance=1,
    dithered=0,
    dither=20,
    seek_dither=20,
    centre=THRUST_UNITS // 2,
    foreign_samples=FOREIGN_SAMPLES,
)
"""Echo of the thrust in millionths, which both autopilots show as sent. A dither of two steps of 20
is a climb of 1 mm/s after one second."""
RATE_UNITS = 10_000
RATE_ECHO = EchoRules(
    tolerance=1, dithered=2, dither=10, seek_dither=10, centre=0, foreign_samples=FOREIGN_SAMPLES
)
"""Echo of body rates in 1e-4 rad/s, which PX4 shows from half a second after the last attitude
setpoint. The dither is 0.06 degrees/s of yaw rate."""
MOST_LEAD_RAD = math.radians(45.0)
"""Largest lead of the commanded heading over the vehicle's. The vehicle lags by 0.3 to 0.4 s, so
that yaw rates up to 110 degrees/s are followed in full."""
LEAST_COS_TILT = 0.1
"""Inverse of ArduPilot's largest thrust boost in a lean (get_throttle_boosted)."""
_PAUSE_NS = 500 * NS_PER_MS
"""Pause in setpoints after which heading and thrust restart."""
_LEVEL_RAD = math.radians(15.0)


class AttitudeOutput(SetpointOutput):
    """SET_ATTITUDE_TARGET, with an attitude or with body rates.

    Thrust is scaled so that the hover thrust of training hovers here. With body rates, thrust acts
    along the body axis on every firmware: a boost that the autopilot adds in a lean is cancelled.
    With an attitude, the boost stays.
    """

    _echo_message = "ATTITUDE_TARGET"

    def __init__(
        self, codec: Codec, meaning: ActionMeaning, profile: Profile, name: Output
    ) -> None:
        self._shows_rates = name == "rates" and profile.shows_rates
        super().__init__(codec, RATE_ECHO if self._shows_rates else THRUST_ECHO)
        self.name = name
        self._trained_hover = meaning.hover_thrust
        self._hover = HoverThrust()
        self._scale: float | None = None
        """Ratio of the vehicle's thrust to the policy's; constant during a stream."""
        self._asked_rad: float | None = None
        """Heading last commanded; None: start at the vehicle's own."""
        self._asked_ns = 0
        self._measured_rad: float | None = None
        self._is_level = False
        self._cos_tilt = 1.0

    def restart(self) -> None:
        """Start a new session: the battery or the vehicle may be another one."""
        super().restart()
        self._hover, self._cos_tilt = HoverThrust(), 1.0
        self._scale = self._measured_rad = self._asked_rad = None

    def released(self) -> None:
        """Note the end of sending; the next stream starts afresh."""
        super().released()
        self._asked_rad = self._scale = None

    def encode(self, action: Action, vehicle: VehicleSession, now_ns: int) -> Encoded | None:
        """Encode the setpoint; None for an attitude before the vehicle's heading is known."""
        if not isinstance(action, AttitudeThrust | BodyRates):
            raise CommandRefusedError(f"{type(action).__name__} has neither attitude nor rates")
        if not (all(map(math.isfinite, action)) and 0.0 <= action.thrust <= 1.0):
            raise CommandRefusedError(f"{action} is not finite, or its thrust not in [0, 1]")
        if self._scale is None or self._sent_ns is None or now_ns - self._sent_ns > _PAUSE_NS:
            self._scale = self._thrust_scale(vehicle)
        is_boosted = isinstance(action, BodyRates) and vehicle.params.traits.boosts_thrust
        boost = self._cos_tilt if is_boosted else 1.0
        shown: Shown = (round(min(self._scale * action.thrust, 1.0) * boost * THRUST_UNITS),)
        status = vehicle.status(now_ns)
        is_idle = shown[0] == 0 and (status is None or status.is_landed is not False)
        is_checked = not is_idle and not self._shows_rates  # leave idle motors idle
        if is_checked:
            shown = self.echo.with_dither(shown, now_ns)
        thrust = shown[0] / THRUST_UNITS
        action = action._replace(thrust=thrust / (self._scale * boost))
        quaternion, rates = None, (0.0, 0.0, 0.0)
        if isinstance(action, BodyRates):
            self._asked_rad = None
            roll, pitch, yaw = (round(rate * RATE_UNITS) for rate in action[1:])
            if self._shows_rates:
                shown, is_checked = self.echo.with_dither((roll, pitch, yaw), now_ns), True
                roll, pitch, yaw = shown
            rates = roll / RATE_UNITS, pitch / RATE_UNITS, yaw / RATE_UNITS
            action = BodyRates(action.thrust, *rates)
        elif self._measured_rad is None:
            return None
        else:
            if not self._follows(vehicle, now_ns):
                self._asked_rad = None
            heading = self._next_heading_rad(self._measured_rad, action.yaw_rate_radps, now_ns)
            quaternion = quaternion_from_euler(action.roll_rad, action.pitch_rad, heading)
        source = vehicle.identity.source
        packet = self._codec.encode_attitude(source, quaternion, rates, thrust, now_ns=now_ns)
        expected = self._expected(shown, vehicle, now_ns) if is_checked else None
        return Encoded(packet, action, expected)

    def _next_heading_rad(self, measured_rad: float, yaw_rate_radps: float, now_ns: int) -> float:
        """Return the heading to command, in [-pi, pi]: integrates the yaw rate, limits the lead."""
        lead_rad, elapsed_ns = 0.0, now_ns - self._asked_ns
        if self._asked_rad is not None and elapsed_ns <= _PAUSE_NS:
            lead_rad = self._asked_rad - measured_rad + yaw_rate_radps * elapsed_ns / NS_PER_S
            lead_rad = math.remainder(lead_rad, math.tau)
            lead_rad = min(max(lead_rad, -MOST_LEAD_RAD), MOST_LEAD_RAD)
        self._asked_rad, self._asked_ns = math.remainder(measured_rad + lead_rad, math.tau), now_ns
        return self._asked_rad

    def _thrust_scale(self, vehicle: VehicleSession) -> float:
        hover = self._hover.value or vehicle.params.values.get(vehicle.profile.hover_param)
        if hover is None or not PLAUSIBLE_THRUST[0] < hover < PLAUSIBLE_THRUST[1]:
            unknown = "the thrust at which this vehicle hovers is not known (MOT_THST_HOVER, "
            unknown += "MPC_THR_HOVER): the policy's thrust goes out as it is, with which "
            vehicle.report(AdviceText(f"{unknown}{self._trained_hover:g} hovers"))
            return 1.0
        return hover / self._trained_hover

    def _compare(self, body: Body | None, vehicle: VehicleSession, arrived_ns: int) -> None:
        """Process attitude, force and echo, by their arrival: PX4's echo has an old timestamp."""
        match body:
            case Attitude():
                self._measured_rad = heading_rad(body.ned_from_body_wxyz)
                tilt = tilt_rad(body.ned_from_body_wxyz)
                self._is_level = tilt < _LEVEL_RAD
                self._cos_tilt = max(math.cos(tilt), LEAST_COS_TILT)
            case SpecificForce():
                self._hover.receive_force(-body.specific_force_body_mps2[2], arrived_ns)
            case AttitudeTarget():
                shown: Shown = (round(body.thrust * THRUST_UNITS),)
                if self._shows_rates:
                    shown = tuple(round(rate * RATE_UNITS) for rate in body.rate_body_radps)
                self.echo.received(shown, arrived_ns // 1000, arrived_ns)
                is_own = self._sent_ns is None or arrived_ns - self._sent_ns > _PAUSE_NS
                if is_own and self._is_level and self._is_flying(vehicle, arrived_ns):
                    self._hover.receive_thrust(body.thrust, arrived_ns)

    def _is_flying(self, vehicle: VehicleSession, now_ns: int) -> bool:
        status = vehicle.status(now_ns)
        return status is not None and status.armed and status.is_landed is False
