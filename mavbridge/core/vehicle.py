"""Values that describe the vehicle, its sticks and the link to it; no arrays, so no numpy to load.

Stamps are nanoseconds of the injected clock, taken where the thing happened (datagram arrival,
handed to the kernel).
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeAlias

from mavbridge.core.address import SocketAddress
from mavbridge.core.reasons import Reason

Output: TypeAlias = Literal["rc-override", "manual-control", "attitude", "rates", "velocity"]
"""RC_CHANNELS_OVERRIDE (ArduPilot), MANUAL_CONTROL (PX4), SET_ATTITUDE_TARGET with an attitude or
with body rates, SET_POSITION_TARGET_LOCAL_NED with a velocity."""
ActionKind: TypeAlias = Literal["sticks", "rates", "attitude", "velocity"]
"""Meaning of the four numbers of an action; ``Action`` has a class for each."""
OnFault: TypeAlias = Literal["auto", "release", "hold", "land", "rtl"]
"""Action that follows the neutral sticks when a flight ends by our own doing."""
FlightEnd: TypeAlias = Literal[
    "course", "duration", "landed", "operator", "signal", "takeover", "disarmed", "fault"
]
"""How a flight of the policy ended: a planned end, the pilot or the vehicle, a fault of ours."""

Risk: TypeAlias = Literal[
    "endless-override", "no-throttle-failsafe", "long-setpoint", "slow-serial"
]
"""A setting of the vehicle or of the link with which a flight is begun only if it is accepted."""


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
    """Vehicle motion at full stick, and the stick's travel that does nothing.

    Linear in between. The defaults are ArduCopter's own.
    """

    lean_deg: float = 30.0
    """Roll or pitch."""
    yaw_rate_degps: float = 202.5
    climb_mps: float = 2.5
    descent_mps: float = 2.5
    lean_dead_zone: float = 0.04
    """Share of the travel to each side of the centre; also in the next two."""
    yaw_dead_zone: float = 0.04
    throttle_dead_zone: float = 0.2


@dataclass(frozen=True, slots=True, kw_only=True)
class ActionMeaning:
    """Meaning of the four numbers of a policy's actions."""

    kind: ActionKind = "sticks"
    stick_gains: StickGains | None = None
    """What full stick was in training; None: sticks go to the vehicle as they are."""
    hover_thrust: float = 0.39
    """Thrust that hovers, in training: for rates and attitude."""
    is_heading_frame: bool = False
    """Velocities are forward, right, down, and not north, east, down."""


NEUTRAL = Sticks(throttle=0.0, yaw=0.0, pitch=0.0, roll=0.0)
IDLE = Sticks(throttle=-1.0, yaw=0.0, pitch=0.0, roll=0.0)
"""Throttle at the bottom, the rest centred: what arming demands."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Have the vehicle do this until the next command."""

    action: Action


@dataclass(frozen=True, slots=True)
class Release:
    """Do not touch the sticks: they belong to the pilot. ``reason`` is shown to the user."""

    reason: Reason


Decision: TypeAlias = Command | Release


class Reading(NamedTuple):
    """One measurement of the vehicle as it came in."""

    arrived_ns: int
    values: tuple[float, ...]
    delay_ns: int = 0
    """From the measured moment to the arrival, by the vehicle's own stamp; 0 = not known, negative
    = stamped in the future, so that the age is not known either."""

    @property
    def happened_ns(self) -> int:
        """The measured moment, from which its age counts."""
        return self.arrived_ns - self.delay_ns

    def is_fresh(self, now_ns: int, limit_ns: int) -> bool:
        """True if it is known to be at most ``limit_ns`` old."""
        return self.delay_ns >= 0 and now_ns - self.happened_ns <= limit_ns


class Telemetry(NamedTuple):
    """Newest reading of each quantity, in MAVLink's frames (NED world, FRD body); None = never."""

    ned_from_body_wxyz: Reading | None = None
    rate_body_radps: Reading | None = None
    velocity_ned_mps: Reading | None = None
    specific_force_body_mps2: Reading | None = None
    position_ned_m: Reading | None = None
    """From the estimator's origin."""
    height_above_home_m: Reading | None = None
    """One number; comes only where a policy takes it."""


class Sample(NamedTuple):
    """One reading on its way from the guard to the flight process."""

    quantity: str
    """Field of ``Telemetry``."""
    reading: Reading


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleStatus:
    """The vehicle's state as its heartbeat and RC_CHANNELS report it."""

    mode: str
    armed: bool
    mode_arrived_ns: int | None = None
    """Arrival of the newest message that tells the mode."""
    rc_sticks: Sticks | None = None
    """Sticks that the vehicle acts on (RC_CHANNELS through its calibration)."""
    rc_channels_us: tuple[int, ...] = ()
    """Readings of the receiver's channels, 0 where there is none; empty when they are old."""
    channels_arrived_ns: int | None = None
    """Arrival of these."""
    rc_arrived_ns: int | None = None
    is_failsafe: bool = False
    """HEARTBEAT.system_status is critical or worse: a failsafe of the vehicle is active."""
    is_landed: bool | None = None
    """None = the vehicle does not say."""
    has_receiver: bool | None = None
    """A radio receiver delivers the pilot's sticks, as seen before our first override; None = not
    known, or we sent sticks before it could be seen."""
    is_receiver_sick: bool = False
    """SYS_STATUS says now that the receiver does not work."""
    pilot_sticks: Sticks | None = None
    """The receiver's sticks as last seen while we sent none."""
    position_ned_m: tuple[float, float, float] | None = None
    """From the estimator's origin; None without a valid, fresh position."""
    is_position_valid: bool | None = None
    """The estimator's own verdict on its horizontal position; None = it does not say."""
    battery_problem: str | None = None
    """The vehicle reports its battery as low or failed, in words for the user."""
    stick_override_ns: int | None = None
    """When it last said that moving sticks have changed its mode."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ModeRoles:
    """Flight modes of one firmware by name, and what each is good for."""

    names: tuple[str, ...] = ()
    """All that can be asked for."""
    hold: str = ""
    """Holds the position whatever the sticks say; empty where there is none, also in the next two.
    """
    land: str = ""
    rtl: str = ""
    takeoff: tuple[str, ...] = ()
    """The mode to arm in for a takeoff by the autopilot's own means, then those it goes through."""
    thrust: tuple[str, ...] = ()
    """The throttle stick is thrust in them, or centred sticks do not level."""
    setpoint: tuple[str, ...] = ()
    """They follow setpoints, and the sticks do nothing."""
    needs_setpoints_first: bool = False
    """A mode of ``setpoint`` is entered only while setpoints flow already."""
    is_silence_failsafe: bool = False
    """Sticks that end are a failsafe, even where a receiver has the next ones."""
    override: str = ""
    """Entered from a mode that flies by itself when the vehicle takes moving sticks for the pilot's
    hand; empty: it never does."""
    needs_sticks_first: bool = False
    """A mode that sticks fly is refused while the vehicle has none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkSnapshot:
    """Everything that the link knows at one tick."""

    telemetry: Telemetry
    samples: tuple[Sample, ...] = ()
    """Readings since the last snapshot, in order of arrival."""
    packets: tuple["ForwardedPacket", ...] = ()
    """Packets of the vehicle since the last snapshot, where the link keeps them."""
    status: VehicleStatus | None
    problem: Reason | None
    """Why sticks may not be sent (no heartbeat, handshake, override switch, no echo), or None."""
    is_overruled: bool = False
    """The vehicle does not act on the sticks that we send: somebody else holds them."""
    is_switched_off: bool = False
    """The pilot holds the switch that forbids overrides (RCn_OPTION 46) low."""
    echo_confirmed: bool = False
    """The vehicle was seen to act on our sticks, or its output has no echo to check."""
    is_released: bool = True
    """The vehicle was seen to act on other sticks than ours since the release, or none was sent."""
    shows_last: bool = True
    """Since the release it shows our last sticks, or others that cannot be told from them."""
    are_sticks_at_rest: bool = True
    """Our last sticks have moved so little for so long that they pass for nobody's hand."""
    interruption: Reason | None = None
    """Why every engagement so far is over, or None: the vehicle has rebooted, or now sends from
    another address. Stays as it is once it has happened."""
    interruptions: int = 0
    """Number of interruptions so far."""
    modes: ModeRoles = ModeRoles()
    refused_mode: str | None = None
    """Mode that the vehicle has just refused to enter, or None."""
    texts: tuple[str, ...] = ()
    """Status texts of the vehicle and warnings of the link since the last snapshot."""


_VEHICLE_SAYS = "vehicle: "


class VehicleText(str):
    """A status text of the vehicle, among those of the link; shown with that word in front."""

    __slots__ = ()

    @property
    def said(self) -> str:
        """The text without the word in front."""
        return self[len(_VEHICLE_SAYS) :]


def said_by_vehicle(text: str) -> VehicleText:
    """Return a text of the vehicle."""
    return VehicleText(_VEHICLE_SAYS + text)


def recorded_text(text: str) -> str:
    """Return a text of a recording, or of another process, as what it was in the link."""
    return VehicleText(text) if text.startswith(_VEHICLE_SAYS) else text


class Outlet(NamedTuple):
    """Where packets to the vehicle leave, for a process that may send in place of the guard."""

    opened: int
    """Number of times that the link was opened: another number is another socket or port."""
    fd: int | None
    """None while it is closed."""
    receiver: SocketAddress | None
    """Address for datagrams; None on a stream."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ActionTrace:
    """One action on its way from the policy to the wire."""

    raw: Action
    clipped: Action
    slewed: Action
    smoothed: Action


class Packet(NamedTuple):
    """One MAVLink packet as it came or left."""

    stamp_ns: int
    """Arrival, or handed to the kernel."""
    data: bytes


class ForwardedPacket(NamedTuple):
    """One packet of the vehicle, with all that a later reader needs to tell its age."""

    arrived_ns: int
    happened_ns: int
    """The moment that it tells about, by the vehicle's own stamp; else its arrival."""
    data: bytes


@dataclass(frozen=True, slots=True, kw_only=True)
class Percentiles:
    """Distribution of a measured quantity; the unit is in the name of what holds it."""

    p50: float
    p99: float
    p999: float
    max: float


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkStats:
    """Counters of the link over one flight; None = not measured."""

    messages_per_s: tuple[tuple[str, float], ...]
    """Mean arrival rate by MAVLink message name."""
    lost_fraction: float | None
    rtt_ms: Percentiles | None
    """Round trips of our own TIMESYNC requests."""
    sent_overrides: int
    """Stick messages handed to the kernel; releases not counted."""
    echo_confirmed: bool | None
    """The vehicle showed our sticks in RC_CHANNELS; None = no stick was sent."""
    unusable_packets: int = 0
    """Corrupt, cut off, or holding NaN."""
    refused_signatures: int = 0
    """Packets without a signature, with a wrong or a replayed one, where signing is on."""
    vehicle_clock_offset_ns: int | None = None
    """Vehicle's clock minus ours, by TIMESYNC: joins our stamps with the vehicle's log."""
    is_timesync_good: bool = False
    """Ages count from the vehicle's own stamps; False = from arrival, which hides delay."""
    slow_clock: str | None = None
    """How far behind real time the vehicle's clock falls; None where it does not."""
    saturated: tuple[tuple[str, float], ...] = ()
    """Share of the stick messages in which a stick of the policy meant more than the vehicle can
    do, by stick; those at 0 are left out."""
    timesync_error_ms: float | None = None
    """The most by which the offset of the clocks, and so every age, may be wrong."""
