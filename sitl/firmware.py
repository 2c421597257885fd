"""What the rest of the simulator knows of a firmware: nothing else asks which one it is.

`sitl.ardupilot.firmware` and `sitl.px4.firmware` are the two.
"""

from collections.abc import Sequence
from typing import NamedTuple, Protocol

from sitl.rotation import Quat, Vec3
from sitl.vehicle.config import VehicleConfig
from sitl.vehicle.dynamics import BodyState


class StatusText(NamedTuple):
    """STATUSTEXT for the ground station, with MAVLink's severity."""

    severity: int
    text: str


class Autopilot(Protocol):
    """One boot of the flight controller without its links; stamps are the caller's clock."""

    sensors_frozen: bool
    """Fault: telemetry and control keep the last state, the physics goes on."""

    @property
    def texts(self) -> list[StatusText]:
        """Texts that every link is to send next."""
        ...

    @property
    def config(self) -> VehicleConfig:
        """What makes this vehicle differ from others."""
        ...

    @property
    def now_ns(self) -> int:
        """Time of the last control step."""
        ...

    @property
    def armed(self) -> bool:
        """The motors may turn."""
        ...

    @property
    def landed(self) -> bool:
        """The vehicle rests on the ground."""
        ...

    @property
    def step_ns(self) -> int:
        """Control period: what `step` advances by."""
        ...

    @property
    def mode_name(self) -> str:
        """The firmware's own name of the flight mode."""
        ...

    @property
    def in_failsafe(self) -> bool:
        """The pilot's sticks are lost, and the firmware acts on it."""
        ...

    @property
    def truth(self) -> BodyState:
        """True state of the vehicle, without sensor faults and noise."""
        ...

    @property
    def sticks_us(self) -> tuple[int, int, int, int]:
        """Roll, pitch, throttle and yaw that the modes use; 0: never had a value.

        Microseconds, 1500 centred, as ArduCopter has them: less is left, nose down and descent.
        """
        ...

    def set_receiver(self, values_us: Sequence[int]) -> None:
        """Move the pilot's sticks and switches, in microseconds by channel."""
        ...

    def step(self) -> None:
        """Advance everything by one control period."""
        ...

    def launch(
        self, position_ned_m: Vec3, velocity_ned_mps: Vec3, ned_from_body_wxyz: Quat
    ) -> None:
        """Put the vehicle in the air in this state, armed, where the sticks lean and climb."""
        ...


class Params(Protocol):
    """Named numbers in a fixed order, which is the index in PARAM_VALUE."""

    @property
    def names(self) -> tuple[str, ...]:
        """All names, sorted."""
        ...

    def __getitem__(self, name: str) -> float: ...

    def set(self, name: str, value: float) -> bool:
        """Store the value; False for an unknown name or a value that does not fit."""
        ...


class Endpoint(Protocol):
    """One MAVLink link of the vehicle."""

    bad_frames: int

    def take_outgoing(self) -> bytes:
        """Everything queued since the last call: whole frames, in order."""
        ...


class Server(Protocol):
    """The MAVLink side of the vehicle, without I/O."""

    @property
    def links(self) -> Sequence[Endpoint]:
        """One endpoint a link."""
        ...

    @property
    def reboot_requested(self) -> bool:
        """A command has requested a reboot."""
        ...

    def receive(self, link_id: int, data: bytes, arrived_ns: int) -> None:
        """Act on the bytes of one datagram, or of one read of a stream."""
        ...

    def step(self, now_ns: int) -> None:
        """Queue what is due on every link; ``now_ns`` is at most one control step ahead."""
        ...


class Firmware(Protocol):
    """A firmware that runs on the simulated vehicle."""

    @property
    def params(self) -> Params:
        """Its parameters, which a reboot leaves."""
        ...

    @property
    def ap(self) -> Autopilot:
        """The flight controller since the last boot."""
        ...

    @property
    def server(self) -> Server:
        """Its links."""
        ...

    def reboot(self) -> None:
        """Restart on the ground at the origin."""
        ...
