"""Base of both simulated firmwares below MAVLink: parameters, sensors, readiness, landing, launch.

`sitl.ardupilot.autopilot` and `sitl.px4.autopilot` hold the differences. No other module asks which
firmware a vehicle runs.
"""

import math
import struct
from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from enum import IntEnum
from itertools import zip_longest
from types import MappingProxyType
from typing import ClassVar, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.clock import NS_PER_S
from sitl.vehicle.config import VehicleConfig
from sitl.vehicle.dynamics import Airframe, BodyState, Quadrotor, SensorNoise, Wind
from sitl.vehicle.rotation import Quat, Vec3, yaw_of

STOPPED = (0.0, 0.0, 0.0, 0.0)
LANDED_AFTER_NS = NS_PER_S
LANDED_SPEED_MPS = 0.3
RECEIVER_PERIOD_NS = NS_PER_S // 50


class Severity(IntEnum):
    """MAV_SEVERITY of a text."""

    CRITICAL, WARNING, INFO = 2, 4, 6


class StatusText(NamedTuple):
    """STATUSTEXT for the ground station."""

    severity: Severity
    text: str


class AttitudeSetpoint(NamedTuple):
    """A valid SET_ATTITUDE_TARGET; body axes are FRD."""

    ned_from_body_wxyz: Quat | None  # None: rates only
    rate_body_radps: Vec3
    thrust: float  # PX4: collective, 0..1; ArduPilot: as GUID_OPTIONS says


class VelocitySetpoint(NamedTuple):
    """Velocity and yaw rate of a valid SET_POSITION_TARGET_LOCAL_NED; positions are dropped."""

    velocity_ned_mps: Vec3
    yaw_rate_radps: float


class Receiver:
    """RC receiver that hears the pilot's transmitter at 50 Hz."""

    def __init__(self, channels_us: Sequence[int] | None) -> None:
        self.channels_us = channels_us  # last channels; None: no receiver
        self._has_signal = channels_us is not None
        self._due_ns = 0

    def move(self, values_us: Sequence[int]) -> None:
        """Move sticks and switches of the transmitter [us] from the next frame on.

        A 0 leaves its channel unchanged. All zeros switch the transmitter off: frames stop, the
        last values stay. A vehicle without a receiver gets one with its first values.
        """
        self._has_signal = any(values_us)
        if self._has_signal:
            pairs = zip_longest(values_us, self.channels_us or (), fillvalue=0)
            self.channels_us = tuple(new or old for new, old in pairs)

    def frame(self, now_ns: int) -> Sequence[int] | None:
        """Return the channels [us] once for each frame, when it is due."""
        if not self._has_signal or now_ns < self._due_ns:
            return None
        self._due_ns = now_ns + RECEIVER_PERIOD_NS
        return self.channels_us


def float32(value: float) -> float:
    """Round to float32, as on the wire. Raises OverflowError beyond its range."""
    (rounded,) = struct.unpack("<f", struct.pack("<f", value))
    return float(rounded)


class Params:
    """Named numbers; the position in the order of their names on the wire is PARAM_VALUE's index.

    An integer travels as its four bytes in the float field of PARAM_VALUE and PARAM_SET, so a peer
    that reads it as a number sees a denormal.
    """

    def __init__(
        self,
        values: Mapping[str, float],
        integers: Collection[str] = (),
        renamed: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        """Store the values as INT32 where the name is in ``integers``, else as float32.

        ``renamed``: names on the wire of those that have another one there.
        """
        self._values = {name: float32(values[name]) for name in values}
        self._integers = integers
        by_wire_name = {renamed.get(name, name): name for name in values}
        self._by_wire_name = {name: by_wire_name[name] for name in sorted(by_wire_name)}
        self.names: tuple[str, ...] = tuple(self._by_wire_name)
        """Names on the wire, in PARAM_VALUE's order."""

    def __getitem__(self, name: str) -> float:
        return self._values[name]

    def __contains__(self, name: str) -> bool:
        return name in self._values

    def get(self, name: str, default: float) -> float:
        """Return the value, or ``default`` if the release lacks the parameter."""
        return self._values.get(name, default)

    def integer(self, name: str) -> int:
        """Return the value of an integer, an enumeration or a bit mask."""
        return int(self._values[name])

    def set(self, name: str, value: float) -> bool:
        """Store the value. Return False for an unknown name or a value outside its type."""
        if name not in self._values or not math.isfinite(value):
            return False
        is_integer = name in self._integers
        kind = "<i" if is_integer else "<f"
        try:
            (new,) = struct.unpack(kind, struct.pack(kind, int(value) if is_integer else value))
        except (OverflowError, struct.error):
            return False
        self._values[name] = new
        return True

    def on_wire(self, wire_name: str) -> tuple[float, int]:
        """Return the float field and the MAV_PARAM_TYPE of PARAM_VALUE."""
        name = self._by_wire_name[wire_name]
        if name not in self._integers:
            return self._values[name], mav.MAV_PARAM_TYPE_REAL32
        (packed,) = struct.unpack("<f", struct.pack("<i", self.integer(name)))
        return packed, mav.MAV_PARAM_TYPE_INT32

    def set_on_wire(self, wire_name: str, packed: float) -> bool:
        """Store the float field of PARAM_SET. Return False if refused, like `set`."""
        name, value = self._by_wire_name.get(wire_name, ""), packed
        if name in self._integers:
            (value,) = struct.unpack("<i", struct.pack("<f", packed))
        return self.set(name, value)


class Autopilot(ABC):
    """One boot of the flight controller, without its links. Stamps use the caller's clock."""

    step_ns: ClassVar[int]  # control period, by which `step` advances
    airframe: ClassVar[Airframe]
    gyro_noise_radps: ClassVar[float] = 0.0
    """Noise of the body rates on each axis, in addition to the conditions'."""
    id_param: ClassVar[str]  # name of the system id's parameter
    battery_mv: ClassVar[int]  # the battery never empties

    def __init__(self, params: Params, config: VehicleConfig, boot_ns: int) -> None:
        self.params = params  # survives a reboot
        self.config = config
        self.boot_ns = boot_ns
        self.now_ns = boot_ns  # time of the last control step
        self.armed = False
        self.landed = True
        self.receiver = Receiver(config.receiver_us)
        self.position_lost = False
        """Injected fault: the estimator has no horizontal position while this is set."""
        self.texts: list[StatusText] = []
        """Status texts to send on every link; the reader empties the list."""
        conditions = config.conditions
        rate_noise_radps = math.hypot(conditions.rate_noise_radps, self.gyro_noise_radps)
        self._quad = Quadrotor(conditions, self.airframe)
        self._wind = Wind(conditions, self.step_ns / NS_PER_S)
        self._noise = SensorNoise(replace(conditions, rate_noise_radps=rate_noise_radps))
        self.sensed = self.truth
        self._still_since_ns: int | None = boot_ns

    @property
    @abstractmethod
    def mode_name(self) -> str:
        """The firmware's name of the flight mode."""

    @property
    @abstractmethod
    def in_failsafe(self) -> bool:
        """True if the pilot's sticks are lost and the firmware acts on it."""

    @property
    @abstractmethod
    def sticks_us(self) -> tuple[int, int, int, int]:
        """Roll, pitch, throttle and yaw that the modes use [us]; 0: never had a value.

        1500 is centred. Smaller is left, nose down and descent, as in ArduCopter.
        """

    @property
    def truth(self) -> BodyState:
        """True state of the vehicle, without sensor noise."""
        return self._quad.body

    @property
    def yaw_rad(self) -> float:
        return yaw_of(self.sensed.ned_from_body_wxyz)

    @property
    def system_id(self) -> int:
        return self.params.integer(self.id_param) & 0xFF  # one byte on the wire

    @property
    def uptime_ns(self) -> int:
        """Time since boot, the clock of all telemetry."""
        return self.now_ns - self.boot_ns

    @property
    def estimator_ready(self) -> bool:
        """True once the attitude is aligned, which arming requires."""
        return self.uptime_ns >= self.config.estimator_ready_s * NS_PER_S

    @property
    def position_ready(self) -> bool:
        is_settled = self.uptime_ns >= self.config.position_ready_s * NS_PER_S
        return is_settled and not self.position_lost

    def step(self) -> None:
        self.now_ns += self.step_ns
        self._read_inputs()
        substeps = self.step_ns // self.airframe.step_ns
        self._quad.step(self._motors(), substeps, self._wind.step())
        self.sensed = self._noise.sense(self.truth)
        self._detect_landing()

    def launch(
        self, position_ned_m: Vec3, velocity_ned_mps: Vec3, ned_from_body_wxyz: Quat
    ) -> None:
        """Put the vehicle into the air in this state, armed, in a mode with lean and climb sticks.

        A mode flown by setpoints is kept.
        """
        self._quad.launch(position_ned_m, velocity_ned_mps, ned_from_body_wxyz)
        self.sensed = self.truth
        self._start_in_air()

    @abstractmethod
    def arm(self) -> bool:
        """Start the motors, or send the refusal as a text. Return True if armed afterwards."""

    @abstractmethod
    def disarm(self, *, force: bool) -> bool:
        """Stop the motors; refused in flight unless forced. Return True if disarmed afterwards."""

    @abstractmethod
    def _read_inputs(self) -> None:
        """Read sticks and setpoints, and decide on mode and arming."""

    @abstractmethod
    def _motors(self) -> tuple[float, ...]:
        """Return the motor commands of this step, each in [0, 1]."""

    @abstractmethod
    def _start_in_air(self) -> None:
        """Arm and fly from the state that the vehicle was just put into."""

    @property
    @abstractmethod
    def _is_pushing(self) -> bool:
        """True if thrust is above half of hover thrust, so that the vehicle is not landed."""

    def _set_landed(self, *, landed: bool) -> None:
        self.landed = landed
        if not landed:
            self._still_since_ns = None

    def _detect_landing(self) -> None:
        body = self.sensed
        is_slow = max(abs(v) for v in body.velocity_ned_mps) < LANDED_SPEED_MPS
        is_still = body.touching and is_slow and not (self.armed and self._is_pushing)
        if not is_still:
            self._still_since_ns = None
        elif self._still_since_ns is None:
            self._still_since_ns = self.now_ns
        if not self.landed and self._has_held(self._still_since_ns, LANDED_AFTER_NS):
            self._set_landed(landed=True)

    def _has_held(self, since_ns: int | None, duration_ns: float) -> bool:
        return since_ns is not None and self.now_ns - since_ns >= duration_ns

    def send_text(self, severity: Severity, text: str) -> None:
        self.texts.append(StatusText(severity, text))
