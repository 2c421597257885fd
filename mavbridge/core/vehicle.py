"""Values that describe the vehicle, its sticks and its link. No arrays, so importing needs no
numpy.

Stamps are nanoseconds of the injected clock, taken at the source (datagram arrival, handed to the
kernel).
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeAlias

from mavbridge.core.address import SocketAddress
from mavbridge.core.reasons import Reason

Output: TypeAlias = Literal["rc-override", "manual-control", "attitude", "rates", "velocity"]
"""RC_CHANNELS_OVERRIDE (ArduPilot), MANUAL_CONTROL (PX4), SET_ATTITUDE_TARGET with an attitude or
with body rates, SET_POSITION_TARGET_LOCAL_NED with a velocity."""
ActionKind: TypeAlias = Literal["sticks", "rates", "attitude", "velocity"]
"""Meaning of an action's four numbers; ``Action`` has a class for each."""
OnFault: TypeAlias = Literal["auto", "release", "hold", "land", "rtl"]
"""What follows the neutral sticks when a flight ends by our own doing."""
FlightEnd: TypeAlias = Literal[
    "course", "stopped", "duration", "landed", "operator", "signal", "takeover", "disarmed", "fault"
]
"""How the policy's flight ended: planned, by the pilot or the vehicle, or by a fault of ours."""

Risk: TypeAlias = Literal[
    "endless-override", "no-throttle-failsafe", "long-setpoint", "slow-serial"
]
"""Settings of vehicle or link with which a flight begins only if the user accepts the risk."""


class Sticks(NamedTuple):
    """Stick positions in [-1, 1], in the order of the action vector.

    +throttle = up (0 is mid-stick), +yaw = nose right, +pitch = stick forward = nose down,
    +roll = right.
    """

    throttle: float
    yaw: float
    pitch: float
    roll: float


class BodyRates(NamedTuple):
    """Collective thrust in [0, 1] and body rates, in FRD axes: + right side down, nose up, nose
    right."""

    thrust: float
    roll_radps: float
    pitch_radps: float
    yaw_radps: float


class AttitudeThrust(NamedTuple):
    """Collective thrust in [0, 1], roll and pitch by MAVLink's signs (+ right side down, + nose
    up), and a yaw rate, + nose right."""

    thrust: float
    roll_rad: float
    pitch_rad: float
    yaw_rate_radps: float


class Velocity(NamedTuple):
    """Velocity and yaw rate, + nose right: north, east, down, or forward, right, down in level axes
    that turn with the nose (``ActionMeaning.is_heading_frame``)."""

    x_mps: float
    y_mps: float
    z_mps: float
    yaw_rate_radps: float


Action: TypeAlias = Sticks | BodyRates | AttitudeThrust | Velocity
ACTION_CLASSES: dict[ActionKind, type[Action]] = {
    "sticks": Sticks,
    "rates": BodyRates,
    "attitude": AttitudeThrust,
    "velocity": Velocity,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class StickGains:
    """Vehicle motion at full stick, and dead zones; linear in between. The defaults are
    ArduCopter's."""

    lean_deg: float = 30.0
    """Roll and pitch."""
    yaw_rate_degps: float = 202.5
    climb_mps: float = 2.5
    descent_mps: float = 2.5
    lean_dead_zone: float = 0.04
    """Dead zone as a share of the travel to each side of the centre."""
    yaw_dead_zone: float = 0.04
    throttle_dead_zone: float = 0.2


@dataclass(frozen=True, slots=True, kw_only=True)
class ActionMeaning:
    """Meaning of the four numbers of a policy's actions."""

    kind: ActionKind = "sticks"
    stick_gains: StickGains | None = None
    """Motion at full stick in training; None: send the sticks unchanged."""
    hover_thrust: float = 0.39
    """Hover thrust in training, for rates and attitude."""
    is_heading_frame: bool = False
    """True: velocities are forward, right, down. False: north, east, down."""


NEUTRAL = Sticks(throttle=0.0, yaw=0.0, pitch=0.0, roll=0.0)
IDLE = Sticks(throttle=-1.0, yaw=0.0, pitch=0.0, roll=0.0)
"""Throttle at the bottom, the rest centred, as arming demands."""


@dataclass(frozen=True, slots=True)
class Release:
    """Leave the sticks to the pilot."""


Decision: TypeAlias = Action | Release
"""An action is held until the next decision."""


class Reading(NamedTuple):
    """One measurement of the vehicle."""

    arrived_ns: int
    values: tuple[float, ...]
    delay_ns: int = 0
    """Time from measurement to arrival, by the vehicle's stamp; 0: unknown. Negative: stamped in
    the future, so that the age is unknown, too."""

    @property
    def happened_ns(self) -> int:
        """Time of the measurement, from which its age counts."""
        return self.arrived_ns - self.delay_ns

    def is_fresh(self, now_ns: int, limit_ns: int) -> bool:
        """True if the reading is known to be at most ``limit_ns`` old."""
        return self.delay_ns >= 0 and now_ns - self.happened_ns <= limit_ns


class Telemetry(NamedTuple):
    """Newest reading of each quantity, in MAVLink's frames (NED world, FRD body); None: none
    yet."""

    ned_from_body_wxyz: Reading | None = None
    rate_body_radps: Reading | None = None
    velocity_ned_mps: Reading | None = None
    specific_force_body_mps2: Reading | None = None
    position_ned_m: Reading | None = None
    """Position from the estimator's origin."""
    height_above_home_m: Reading | None = None
    """One number; requested only if the policy takes it."""

    @property
    def motion(self) -> tuple[Reading | None, ...]:
        """Attitude, body rate, velocity and specific force."""
        return self[:4]

    @property
    def attitude_arrived_ns(self) -> int:
        """Arrival of the newest attitude; 0 before the first."""
        attitude = self.ned_from_body_wxyz
        return 0 if attitude is None else attitude.arrived_ns


class Sample(NamedTuple):
    """One reading, passed from the guard to the flight process."""

    quantity: str
    """Field of ``Telemetry``."""
    reading: Reading


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleStatus:
    """The vehicle's state as HEARTBEAT, RC_CHANNELS and others report it."""

    mode: str
    armed: bool
    mode_arrived_ns: int | None = None
    """Arrival of the newest message that reports the mode."""
    armed_arrived_ns: int | None = None
    """Arrival of the newest message that reports ``armed``: HEARTBEAT or an EVENT."""
    rc_sticks: Sticks | None = None
    """Sticks that the vehicle acts on (RC_CHANNELS through its calibration); None if stale."""
    rc_channels_us: tuple[int, ...] = ()
    """Radio channels, 0 if undriven; empty if stale."""
    channels_arrived_ns: int | None = None
    """Arrival of ``rc_channels_us``."""
    rc_arrived_ns: int | None = None
    is_failsafe: bool = False
    """A failsafe is active: HEARTBEAT.system_status is critical or worse."""
    is_mode_chosen: bool = False
    """CURRENT_MODE reports that somebody has asked for the mode, not a failsafe."""
    is_landed: bool | None = None
    """None: the vehicle does not report it."""
    has_receiver: bool | None = None
    """True if a radio receiver delivers the pilot's sticks, as seen before our first override;
    None: not known, or we sent sticks before it could be seen."""
    is_receiver_sick: bool = False
    """SYS_STATUS reports that the receiver does not work."""
    pilot_sticks: Sticks | None = None
    """The receiver's sticks when we last sent none."""
    position_ned_m: tuple[float, float, float] | None = None
    """Position from the estimator's origin; None without a valid, fresh position."""
    is_position_valid: bool | None = None
    """The estimator's own verdict on its horizontal position; None: not reported."""
    battery_problem: Reason | None = None
    """Why the battery counts as low or failed; None: it does not."""
    is_charge_known: bool = True
    """False if ``envelope.min_battery`` is set and no charge is reported to compare with it."""
    stick_override_ns: int | None = None
    """When it last reported that moving sticks have changed its mode."""
    stick_loss_ns: int | None = None
    """When it last reported that it gets no sticks any more."""

    @property
    def height_m(self) -> float | None:
        """Height above the estimator's origin; None without a position."""
        return None if self.position_ned_m is None else -self.position_ned_m[2]


@dataclass(frozen=True, slots=True, kw_only=True)
class ModeRoles:
    """Flight modes of one firmware by name, and their properties."""

    names: tuple[str, ...] = ()
    """Modes that can be requested."""
    hold: str = ""
    """Mode that holds the position and ignores the sticks; empty: the firmware has none."""
    land: str = ""
    rtl: str = ""
    takeoff: tuple[str, ...] = ()
    """Mode to arm in for an autonomous takeoff, then the modes that the takeoff passes through."""
    thrust: tuple[str, ...] = ()
    """Modes in which the throttle stick is thrust, or centred sticks do not level."""
    setpoint: tuple[str, ...] = ()
    """Modes that follow setpoints and ignore the sticks."""
    needs_setpoints_first: bool = False
    """True if a mode of ``setpoint`` can be entered only while setpoints are already flowing."""
    is_silence_failsafe: bool = False
    """True if the end of our sticks is a failsafe even with a working receiver."""
    override: str = ""
    """Mode that an autonomous mode gives way to when sticks move as by a pilot's hand; empty:
    none."""
    needs_sticks_first: bool = False
    """True if modes flown by sticks are refused while the vehicle receives none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkSnapshot:
    """Everything that the link knows at one step."""

    telemetry: Telemetry
    status: VehicleStatus | None
    problem: Reason | None
    """Why actions must not be sent (no heartbeat, handshake, override switch, no echo), or None."""
    overruled: Reason | None = None
    """How the vehicle shows that it acts on other sticks than ours, or None."""
    is_switched_off: bool = False
    """The pilot holds the switch that forbids overrides (RCn_OPTION 46) low."""
    echo_confirmed: bool = False
    """The vehicle has shown that it acts on our sticks, or the output has no echo to check."""
    is_released: bool = True
    """The vehicle has shown other sticks than ours since the release, or none was sent."""
    shows_last: bool = True
    """Since the release the vehicle shows our last sticks, or sticks indistinguishable from
    them."""
    are_sticks_at_rest: bool = True
    """Our last sticks have moved so little, for so long, that they do not count as a pilot's
    hand."""
    interruption: Reason | None = None
    """Why all engagements so far are over, or None: the vehicle has rebooted or changed its
    address. Stays set."""
    interruptions: int = 0
    """Number of interruptions so far."""
    modes: ModeRoles = ModeRoles()
    refused_mode: str | None = None
    """Mode that the vehicle has just refused, or None."""
    texts: tuple[str, ...] = ()
    """Status texts of the vehicle and warnings of the link since the last snapshot."""


_VEHICLE_SAYS = "vehicle: "


class VehicleText(str):
    """Status text of the vehicle; shown with the prefix "vehicle: "."""

    __slots__ = ()

    @property
    def said(self) -> str:
        """The text without its prefix."""
        return self[len(_VEHICLE_SAYS) :]


class AdviceText(str):
    """Text of the link about parameters or sticks; a check shows these in other rows."""

    __slots__ = ()


def said_by_vehicle(text: str) -> VehicleText:
    """Return a text of the vehicle."""
    return VehicleText(_VEHICLE_SAYS + text)


def recorded_text(text: str) -> str:
    """Restore a text from a recording or another process."""
    return VehicleText(text) if text.startswith(_VEHICLE_SAYS) else text


class Outlet(NamedTuple):
    """Where packets to the vehicle leave, for a process that sends in place of the guard."""

    opened: int
    """Number of times that the link was opened: a new number is a new socket or port."""
    fd: int | None
    """File descriptor; None while the link is closed."""
    receiver: SocketAddress | None
    """Address for datagrams; None on a stream."""


class ActionTrace(NamedTuple):
    """One action's way from the policy to the wire."""

    raw: Action
    clipped: Action
    slewed: Action
    smoothed: Action


class ForwardedPacket(NamedTuple):
    """One packet of the vehicle, with what a later reader needs to compute its age."""

    arrived_ns: int
    happened_ns: int
    """Time that the packet describes, by the vehicle's stamp if it has one, else its arrival."""
    data: bytes


class LinkArrivals(NamedTuple):
    """Samples and packets from the vehicle since the last call, in order of arrival."""

    samples: tuple[Sample, ...]
    packets: tuple[ForwardedPacket, ...]
    """Empty unless the link keeps packets."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Percentiles:
    """Distribution of a measured quantity. The name of the field that holds it tells the unit."""

    p50: float
    p99: float
    p999: float
    max: float


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkStats:
    """Counters of the link over one flight; None: not measured."""

    messages_per_s: dict[str, float]
    """Mean arrival rate by MAVLink message name."""
    lost_fraction: float | None
    rtt_ms: Percentiles | None
    """Round trips of our TIMESYNC requests."""
    sent_actions: int
    """Sticks and setpoints handed to the kernel, releases not counted."""
    echo_confirmed: bool | None
    """The vehicle showed our sticks in RC_CHANNELS; None: no stick was sent."""
    unusable_packets: int = 0
    """Packets that were corrupt, truncated or contained NaN."""
    refused_signatures: int = 0
    """With signing: packets without a signature, or with a wrong or replayed one."""
    vehicle_clock_offset_ns: int | None = None
    """Vehicle's clock minus ours, by TIMESYNC: relates our stamps to the vehicle's log."""
    is_timesync_good: bool = False
    """True: ages count from the vehicle's stamps. False: from arrival, which hides latency."""
    slow_clock: str | None = None
    """By how much the vehicle's clock lags real time, in words; None: it does not."""
    timesync_error_ms: float | None = None
    """Upper bound of the error of the clocks' offset, and so of every age."""
