"""What the bridge understands of MAVLink: one frozen record per message, SI units, validated."""

from dataclasses import dataclass
from typing import NamedTuple, TypeAlias


class Source(NamedTuple):
    """Who sent a message."""

    system: int
    component: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Heartbeat:
    """HEARTBEAT (0)."""

    vehicle_type: int
    autopilot: int
    base_mode: int
    custom_mode: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Attitude:
    """ATTITUDE_QUATERNION (31) or ATTITUDE (30)."""

    is_quaternion: bool
    boot_ms: int
    ned_from_body_wxyz: tuple[float, float, float, float]
    rate_body_radps: tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalVelocity:
    """Velocity of LOCAL_POSITION_NED (32)."""

    velocity_ned_mps: tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class SpecificForce:
    """Accelerometer of HIGHRES_IMU (105), SCALED_IMU (26), SCALED_IMU2 (116) or RAW_IMU (27)."""

    source: str
    specific_force_body_mps2: tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class RcChannels:
    """RC_CHANNELS (65): what the vehicle acts on, in microseconds; 0 = absent."""

    channels_us: tuple[int, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class CommandAck:
    """COMMAND_ACK (77)."""

    command: int
    result: int
    target: Source
    """Whose command was answered; zeros where the vehicle does not say."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ParamValue:
    """PARAM_VALUE (22), as ArduPilot encodes it: the number itself."""

    name: str
    value: float


@dataclass(frozen=True, slots=True, kw_only=True)
class StatusText:
    """STATUSTEXT (253)."""

    text: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Timesync:
    """TIMESYNC (111)."""

    tc1: int
    ts1: int


@dataclass(frozen=True, slots=True, kw_only=True)
class AutopilotVersion:
    """AUTOPILOT_VERSION (148)."""

    version: str


Body: TypeAlias = (
    Heartbeat
    | Attitude
    | LocalVelocity
    | SpecificForce
    | RcChannels
    | CommandAck
    | ParamValue
    | StatusText
    | Timesync
    | AutopilotVersion
)


class Incoming(NamedTuple):
    """One message off the wire."""

    source: Source
    sequence: int
    name: str
    body: Body | None
    """None: a message that is counted, but that nothing here needs."""
