"""Steps of the link between the bridge and the vehicle, and of other stations on it."""

import socket
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeAlias

from pymavlink.dialects.v20 import ardupilotmega as dialect

from sitl import UsageError
from sitl.clock import NS_PER_MS
from sitl.faults.stage.carriers import LOOPBACK, SerialCarrier, UdpCarrier
from sitl.faults.stage.link import LinkFaults
from sitl.faults.stage.relay import VEHICLE
from sitl.faults.stage.stage import Stage


@dataclass(frozen=True, kw_only=True)
class Link:
    """Break the link from now on; without faults it is whole again.

    The faults are those of ``LinkFaults``. With ``ramp_s`` the delay grows in ``ramp_steps`` equal
    steps, so that no packet is much later than the one before.
    """

    way: Literal["both", "to_vehicle", "to_bridge"] = "both"
    loss: float = 0.0
    duplicate: float = 0.0
    corrupt: float = 0.0
    reorder: float = 0.0
    delay_ms: float = 0.0
    jitter_ms: float = 0.0
    hole_ms: float = 0.0
    hole_every_ms: float = 0.0
    bytes_per_s: float = 0.0
    ramp_s: float = 0.0
    ramp_steps: int = 1

    def perform(self, stage: Stage) -> int:
        """Returns the moment of the first step."""
        began_ns = self._impair(stage, 1 / self.ramp_steps)
        for step in range(2, self.ramp_steps + 1):
            stage.observe(self.ramp_s / self.ramp_steps)
            self._impair(stage, step / self.ramp_steps)
        return began_ns

    def _impair(self, stage: Stage, part: float) -> int:
        faults = LinkFaults(
            loss=self.loss,
            duplicate=self.duplicate,
            corrupt=self.corrupt,
            reorder=self.reorder,
            delay_ms=self.delay_ms * part,
            jitter_ms=self.jitter_ms,
            hole_ms=self.hole_ms,
            hole_every_ms=self.hole_every_ms,
            bytes_per_s=self.bytes_per_s,
        )
        return stage.relay.impair(
            to_vehicle=None if self.way == "to_bridge" else faults,
            to_bridge=None if self.way == "to_vehicle" else faults,
        )


@dataclass(frozen=True, kw_only=True)
class Silence:
    """Nothing passes for a while; then the link is whole again."""

    s: float
    way: Literal["both", "to_vehicle", "to_bridge"] = "both"

    def perform(self, stage: Stage) -> int:
        """Returns the moment of the beginning."""
        began_ns = Link(way=self.way, loss=1.0).perform(stage)
        stage.observe(self.s)
        Link(way=self.way).perform(stage)
        return began_ns


@dataclass(frozen=True, kw_only=True)
class Broken:
    """The link breaks as its kind does: UDP goes on from another port after ``s``, TCP closes, a
    serial port is unplugged."""

    s: float = 0.0
    """Nothing passes for so long."""

    def perform(self, stage: Stage) -> int:
        """Returns the moment of the beginning."""
        began_ns = Link(loss=1.0).perform(stage) if self.s else stage.clock.now_ns()
        stage.observe(self.s)
        stage.relay.carrier.fail()
        if self.s:
            Link().perform(stage)
        return began_ns


@dataclass(frozen=True, kw_only=True)
class Unread:
    """The vehicle's end of a serial port reads nothing for a while, and then on."""

    s: float

    def perform(self, stage: Stage) -> int:
        """Returns the moment of the beginning."""
        carrier = stage.relay.carrier
        if not isinstance(carrier, SerialCarrier):
            raise UsageError('this flight has no serial port: carrier = "serial" gives it one')
        began_ns = stage.clock.now_ns()
        carrier.is_read = False
        stage.observe(self.s)
        carrier.is_read = True
        return began_ns


@dataclass(frozen=True, kw_only=True)
class DuplicateSystem:
    """Another vehicle of the same system id, disarmed, sends to the bridge from its own port."""

    s: float
    hz: float = 10.0

    def perform(self, stage: Stage) -> int:
        """Returns the moment of its first packets."""
        carrier = stage.relay.carrier
        if not isinstance(carrier, UdpCarrier):
            raise UsageError("only with UDP can a second vehicle send to the bridge")
        other = dialect.MAVLink(None, srcSystem=VEHICLE[0], srcComponent=VEHICLE[1])
        kind = dialect.MAV_AUTOPILOT_PX4 if stage.is_px4 else dialect.MAV_AUTOPILOT_ARDUPILOTMEGA
        heartbeat = dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_QUADROTOR, kind, 0, 0, 4, 3)
        began_ns = stage.clock.now_ns()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.bind((LOOPBACK, 0))
            for _ in range(round(self.s * self.hz)):
                boot_ms = stage.clock.now_ns() // NS_PER_MS % 2**32
                attitude = dialect.MAVLink_attitude_message(boot_ms, 0.5, 0.5, 0, 0, 0, 0)
                packets = heartbeat.pack(other) + attitude.pack(other)
                sender.sendto(packets, carrier.bridge)
                stage.observe(1 / self.hz)
        return began_ns


@dataclass(frozen=True, kw_only=True)
class Rates:
    """A ground station asks the vehicle for few messages: by their interval and, on ArduPilot, by
    data streams."""

    hz: float
    names: list[str]

    def perform(self, stage: Stage) -> int:
        """Returns the moment."""
        relay, began_ns = stage.relay, stage.clock.now_ns()
        for name in self.names:
            number = getattr(dialect, f"MAVLINK_MSG_ID_{name}")
            relay.command(dialect.MAV_CMD_SET_MESSAGE_INTERVAL, number, 1e6 / self.hz)
        if not stage.is_px4:
            every = dialect.MAV_DATA_STREAM_ALL
            rate = dialect.MAVLink_request_data_stream_message(*VEHICLE, every, round(self.hz), 1)
            relay.inject(rate)
        return began_ns


LinkStep: TypeAlias = Link | Silence | Broken | Unread | DuplicateSystem | Rates
LINK_KINDS: dict[str, Callable[..., LinkStep]] = {
    "link": Link,
    "silence": Silence,
    "broken": Broken,
    "unread": Unread,
    "duplicate-system": DuplicateSystem,
    "rates": Rates,
}
"""Steps by the key ``do`` of a scenario."""
