"""Records of the MAVLink messages that mavbridge uses: frozen, in SI units, checked."""

import struct
from typing import NamedTuple, TypeAlias

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.vehicle import Sticks

_REAL, _INTEGER = struct.Struct("<f"), struct.Struct("<i")
_LEAST, _MOST = -(2**31), 2**31 - 1


class Endpoint(NamedTuple):
    """MAVLink address of a sender or a receiver."""

    system: int
    component: int


class Heartbeat(NamedTuple):
    """HEARTBEAT (0)."""

    vehicle_type: int
    autopilot: int
    base_mode: int
    custom_mode: int
    system_status: int


class CurrentMode(NamedTuple):
    """CURRENT_MODE (436)."""

    custom_mode: int
    intended_custom_mode: int
    """Mode requested last; 0: not reported. If it differs from the present mode, the vehicle has
    left it by itself, in a failsafe."""


class Event(NamedTuple):
    """EVENT (410): one-time event; each firmware numbers its own."""

    event_id: int
    sequence: int
    """Number of the event on this link, modulo 65536."""


class Attitude(NamedTuple):
    """ATTITUDE_QUATERNION (31) or ATTITUDE (30)."""

    is_quaternion: bool
    boot_us: int
    """Vehicle's clock since boot, as in all measurements; 0: not reported."""
    ned_from_body_wxyz: tuple[float, float, float, float]
    rate_body_radps: tuple[float, float, float]


class LocalVelocity(NamedTuple):
    """LOCAL_POSITION_NED (32)."""

    boot_us: int
    velocity_ned_mps: tuple[float, float, float]
    position_ned_m: tuple[float, float, float] | None = None
    """Position from the estimator's origin; None if it is not finite."""


class SpecificForce(NamedTuple):
    """Accelerometer of HIGHRES_IMU (105), SCALED_IMU (26), SCALED_IMU2 (116) or RAW_IMU (27)."""

    message_name: str
    boot_us: int
    specific_force_body_mps2: tuple[float, float, float]


class RcChannels(NamedTuple):
    """RC_CHANNELS (65): channels that the vehicle acts on [us]; 0: unused, 65535, out of range."""

    channels_us: tuple[int, ...]
    """At least eight."""
    boot_us: int
    """Vehicle's clock since boot."""


RESTART_STEP_US, RESTART_STAMPS = 1_000_000, 2
"""Step back of a timestamp that may mean a late datagram or a clock restart, and the number of
consecutive ones that mean a restart."""
WRAP_US = 2**32 * 1000
"""Period of ``time_boot_ms``: 49.7 days."""


def later_by_us(stamp_us: int, other_us: int) -> int:
    """Return the time by which one stamp of the vehicle's clock is later than another.

    Less than ``RESTART_STEP_US`` across the wrap is a wrap: no vehicle reboots that fast.
    """
    across_us = (stamp_us - other_us + RESTART_STEP_US) % WRAP_US - RESTART_STEP_US
    return across_us if across_us <= RESTART_STEP_US else stamp_us - other_us


class StampOrder:
    """Order of one message by the vehicle's stamps: late and doubled datagrams are left out.

    Two stamps in a row that are far back mean that the clock has restarted, or that one wrong stamp
    has ended.
    """

    def __init__(self) -> None:
        self.newest_us = 0
        """0: none yet."""
        self._old = 0

    def accepts(self, stamp_us: int) -> bool:
        """Note a stamp; return False if it is late. 0, no stamp, is accepted."""
        later_us = later_by_us(stamp_us, self.newest_us)
        if stamp_us > 0 < self.newest_us and later_us <= 0:
            self._old = self._old + 1 if later_us < -RESTART_STEP_US else 0
            if self._old < RESTART_STAMPS:
                return False
        self.newest_us, self._old = stamp_us, 0
        return True


STICK_END = 1000
"""Full scale of MAVLink MANUAL_CONTROL: x forward, y right and r nose right in -1000..1000, z up in
0..1000."""


class ManualControl(NamedTuple):
    """MANUAL_CONTROL (69) from a vehicle: the raw sticks that it acts on."""

    x: int
    """Forward, -1000 to 1000. The same range holds for y (right) and r (nose right)."""
    y: int
    z: int
    """Up, 0 to 1000."""
    r: int

    @property
    def sticks(self) -> Sticks:
        """The integers as sticks."""
        x, y, z, r = self
        return Sticks(2 * z / STICK_END - 1, r / STICK_END, x / STICK_END, y / STICK_END)


class AttitudeTarget(NamedTuple):
    """ATTITUDE_TARGET (83)."""

    rate_body_radps: tuple[float, float, float]
    thrust: float


class VelocityTarget(NamedTuple):
    """POSITION_TARGET_LOCAL_NED (85)."""

    type_mask: int
    velocity_ned_mps: tuple[float, float, float]


class Altitude(NamedTuple):
    """GLOBAL_POSITION_INT (33); only the heights are used."""

    amsl_m: float
    """Height above mean sea level."""
    above_home_m: float
    boot_us: int


class SystemStatus(NamedTuple):
    """SYS_STATUS (1)."""

    present: int
    """MAV_SYS_STATUS_SENSOR bits of the sensors that are present and enabled."""
    healthy: int
    battery_percent: int
    """-1: unknown."""


class LandedState(NamedTuple):
    """EXTENDED_SYS_STATE (245)."""

    landed_state: int
    """MAV_LANDED_STATE."""


class EstimatorFlags(NamedTuple):
    """EKF_STATUS_REPORT (193, ArduPilot) or ESTIMATOR_STATUS (230, PX4)."""

    flags: int
    """ESTIMATOR_STATUS_FLAGS; the lowest ten bits agree in both messages."""


class CommandAck(NamedTuple):
    """COMMAND_ACK (77)."""

    command: int
    result: int
    target: Endpoint
    """Sender of the command; zeros if the vehicle does not fill it in."""


class ParamValue(NamedTuple):
    """PARAM_VALUE (22)."""

    name: str
    value: float
    """Numeric value of a parameter of any type."""
    kind: int = dialect.MAV_PARAM_TYPE_REAL32
    """MAV_PARAM_TYPE."""

    def from_bytes(self) -> "ParamValue":
        """Return the value of a vehicle that stores integers in the float's bytes (PX4)."""
        if self.kind != dialect.MAV_PARAM_TYPE_INT32:
            return self
        (number,) = _INTEGER.unpack(_REAL.pack(self.value))
        return self._replace(value=float(number))


class ParamAbsent(NamedTuple):
    """PARAM_ERROR (345): the vehicle has no parameter of this name."""

    name: str


class StatusText(NamedTuple):
    """STATUSTEXT (253)."""

    text: str
    text_id: int = 0
    """Number of a text sent in several pieces; 0: the text is complete."""
    sequence: int = 0
    """Index of this piece."""
    is_full: bool = False
    """True if another piece follows: this one fills its message."""


class Timesync(NamedTuple):
    """TIMESYNC (111) [ns]."""

    tc1: int
    ts1: int


class AutopilotVersion(NamedTuple):
    """AUTOPILOT_VERSION (148)."""

    version: str


Body: TypeAlias = (
    Heartbeat
    | CurrentMode
    | Event
    | Attitude
    | LocalVelocity
    | SpecificForce
    | RcChannels
    | ManualControl
    | AttitudeTarget
    | VelocityTarget
    | Altitude
    | SystemStatus
    | LandedState
    | EstimatorFlags
    | CommandAck
    | ParamValue
    | ParamAbsent
    | StatusText
    | Timesync
    | AutopilotVersion
)


Measurement: TypeAlias = Attitude | LocalVelocity | SpecificForce | Altitude
"""Parts of the vehicle's state, each with a timestamp of the vehicle."""


class ReceivedMessage(NamedTuple):
    """One packet with a valid checksum."""

    source: Endpoint
    sequence: int
    name: str
    body: Body | None
    """None: the bridge does not use the message, or its values are unusable."""
    packet: bytes
    is_unusable: bool
    """True if its values are, such as NaN."""


class CommandRequest(NamedTuple):
    """COMMAND_LONG (76); omitted parameters are zero."""

    command: int
    params: tuple[float, ...]


class ParamRequest(NamedTuple):
    """PARAM_REQUEST_READ (20) by name."""

    name: str


class ParamWrite(NamedTuple):
    """PARAM_SET (23)."""

    name: str
    value: float
    kind: int = dialect.MAV_PARAM_TYPE_REAL32
    """MAV_PARAM_TYPE."""

    def as_bytes(self) -> "ParamWrite":
        """Return the write for a vehicle that reads integers from the float's bytes (PX4)."""
        if self.kind != dialect.MAV_PARAM_TYPE_INT32:
            return self
        number = round(min(max(self.value, _LEAST), _MOST))
        return self._replace(value=_REAL.unpack(_INTEGER.pack(number))[0])


Request: TypeAlias = CommandRequest | ParamRequest | ParamWrite
