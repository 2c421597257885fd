"""Flight controllers of the contract suite, and a companion that talks to them."""

import math
from collections.abc import Callable
from typing import Any

import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.clock import NS_PER_MS, NS_PER_S, Clock
from sitl.course import AirborneStart
from sitl.simulated_vehicle import SimulatedVehicle
from sitl.vehicle.config import VehicleConfig

GCS = 255
TICK_NS = 5 * NS_PER_MS
ARM = mav.MAV_CMD_COMPONENT_ARM_DISARM
FORCE = 21196
REBOOT_FORCE = 20190226
VELOCITY_MASK = 0x5C7
"""All fields ignored but a velocity and a yaw rate."""
ALOFT = AirborneStart(position_ned_m=(0.0, 0.0, -8.0))


class MockPeer:
    """The vehicle of ``sitl`` in this process. Only ``advance`` moves its time."""

    def __init__(self, config: VehicleConfig) -> None:
        self._now_ns = 0
        self.vehicle = SimulatedVehicle(links=1, boot_ns=0, config=config)

    def now_ns(self) -> int:
        return self._now_ns

    def send(self, data: bytes) -> None:
        self.vehicle.receive(0, data, self._now_ns)

    def advance(self, duration_ns: int) -> bytes:
        """Let time pass; return the bytes received meanwhile."""
        end_ns = self._now_ns + duration_ns
        taken = b""
        while self._now_ns < end_ns:
            self._now_ns = min(end_ns, self._now_ns + 2_500_000)
            self.vehicle.step(self._now_ns)
            taken += self.vehicle.take_outgoing(0)
        return taken

    def put_in_air(self) -> None:
        """Spare a simulated vehicle its takeoff."""
        self.vehicle.launch(ALOFT)


class ExternalPeer:
    """A flight controller at a pymavlink address: ``udp:127.0.0.1:14550``, ``/dev/ttyACM0``."""

    def __init__(self, address: str, baud: int = 115_200) -> None:
        self._clock = Clock()
        self._link = mavutil.mavlink_connection(address, baud=baud)

    def now_ns(self) -> int:
        return self._clock.now_ns()

    def send(self, data: bytes) -> None:
        self._link.write(data)

    def advance(self, duration_ns: int) -> bytes:
        """Read every few milliseconds: a second of telemetry is more than a socket holds."""
        end_ns = self._clock.now_ns() + duration_ns
        taken = self._read()
        while (now_ns := self._clock.now_ns()) < end_ns:
            self._clock.sleep_until_ns(min(end_ns, now_ns + TICK_NS))
            taken += self._read()
        return taken

    def _read(self) -> bytes:
        taken = b""
        while data := self._link.recv(65_535):
            taken += bytes(data)
        return taken

    def put_in_air(self) -> None:
        pass

    def close(self) -> None:
        self._link.close()


Peer = MockPeer | ExternalPeer
"""A flight controller at the other end of a byte link."""


class Companion:
    """A ground station or companion computer: frames messages, waits for answers."""

    def __init__(self, peer: Peer) -> None:
        self.peer = peer
        self.may_arm = False
        """Set by fixtures of tests that declare that they arm; otherwise arming is refused."""
        self.seen: list[Any] = []
        """All messages since it was last cleared."""
        self._unread: list[Any] = []
        self._mav = mav.MAVLink(None, srcComponent=mav.MAV_COMP_ID_ONBOARD_COMPUTER)
        self._mav.robust_parsing = True
        self._changed_params: dict[str, tuple[int, float]] = {}
        self._streams: set[int] = set()

    def send(self, message: Any, *, system_id: int = GCS) -> None:
        is_arming = getattr(message, "command", 0) == ARM and message.param1 == 1
        assert self.may_arm or not is_arming, "ask for the fixture of a test that arms"
        self._mav.srcSystem = system_id
        self.peer.send(message.pack(self._mav))

    def advance(self, seconds: float) -> list[Any]:
        """Let time pass; return the new messages, and those that `wait` has left."""
        data = self.peer.advance(round(seconds * NS_PER_S))
        # Messages unknown to pymavlink's dialect arrive as raw bytes, with component 0.
        new = [m for m in self._mav.parse_buffer(data) or [] if m.get_srcComponent() in (0, 1)]
        self.seen += new
        messages, self._unread = self._unread + new, []
        return messages

    def find(
        self, name: str, timeout_s: float = 3.0, where: Callable[[Any], bool] = lambda _: True
    ) -> Any | None:
        """Return the next message of that name; None if there is none."""
        end_ns = self.peer.now_ns() + round(timeout_s * NS_PER_S)
        while self.peer.now_ns() < end_ns:
            messages = self.advance(TICK_NS / NS_PER_S)
            for index, message in enumerate(messages):
                if message.get_type() == name and where(message):
                    self._unread = messages[index + 1 :]
                    return message
        return None

    def wait(
        self, name: str, timeout_s: float = 3.0, where: Callable[[Any], bool] = lambda _: True
    ) -> Any:
        """Return the next message of that name; fail the test if there is none."""
        message = self.find(name, timeout_s, where)
        return message or pytest.fail(f"no such {name} within {timeout_s} s")

    def send_command(
        self, number: int, *params: float, attempt: int = 0, system_id: int = GCS
    ) -> None:
        """Send a command; its ack is left among the messages."""
        padded = (*params, *[0.0] * (7 - len(params)))
        message = mav.MAVLink_command_long_message(1, 1, number, attempt, *padded)
        self.send(message, system_id=system_id)

    def command(self, number: int, *params: float, system_id: int = GCS) -> int:
        """Send a command, and repeat it if its ack is lost; return the result in the ack."""
        for attempt in range(3):
            self.send_command(number, *params, attempt=attempt, system_id=system_id)
            ack = self.find("COMMAND_ACK", 1.0, lambda m: m.command == number)
            if ack is not None:
                return int(ack.result)
        return pytest.fail(f"command {number} is not acknowledged")

    def request(self, message_id: int, name: str) -> Any:
        """Request a message by MAV_CMD_REQUEST_MESSAGE, and return it."""
        for _ in range(3):
            self.send_command(mav.MAV_CMD_REQUEST_MESSAGE, message_id)
            message = self.find(name, 1.0)
            if message is not None:
                return message
        return pytest.fail(f"no {name} on request")

    def stream(self, message_id: int, rate_hz: float) -> int:
        """Request a rate; it is reset at the end of the test."""
        self._streams.add(message_id)
        return self.command(mav.MAV_CMD_SET_MESSAGE_INTERVAL, message_id, int(1e6 / rate_hz))

    def arm(self) -> int:
        return self.command(ARM, 1)

    @property
    def is_external(self) -> bool:
        """True unless the vehicle is the one of ``sitl``."""
        return isinstance(self.peer, ExternalPeer)

    @property
    def in_the_air(self) -> bool:
        message_id = mav.MAVLINK_MSG_ID_EXTENDED_SYS_STATE
        state = self.request(message_id, "EXTENDED_SYS_STATE").landed_state
        return bool(state != mav.MAV_LANDED_STATE_ON_GROUND)

    def come_down(self) -> None:
        """Get to the ground and disarm, by falling if in the air. Only a simulated one may fly."""
        self.command(ARM, 0, FORCE)
        for _ in range(50):
            if not self.in_the_air:
                break
            self.advance(0.2)

    def get_param(self, name: str) -> float:
        return float(self.read_param(name).param_value)

    def read_param(self, *names: str) -> Any:
        """Return PARAM_VALUE, as received, of the first of these names that the vehicle knows."""
        for name in names * 3:
            self.send(mav.MAVLink_param_request_read_message(1, 1, name.encode(), -1))
            message = self.find("PARAM_VALUE", 1.0, lambda m, name=name: m.param_id == name)
            if message is not None:
                return message
        return pytest.fail(f"no parameter {' or '.join(names)}")

    def set_param(self, name: str, value: float) -> float:
        """Set a parameter until the end of the test; return its value afterwards."""
        old = self.read_param(name)
        self._changed_params.setdefault(name, (old.param_type, old.param_value))
        return self.write_param(name, old.param_type, value)

    def write_param(self, name: str, kind: int, value: float) -> float:
        self.send(mav.MAVLink_param_set_message(1, 1, name.encode(), value, kind))
        return float(self.wait("PARAM_VALUE", where=lambda m: m.param_id == name).param_value)

    def restore(self) -> None:
        """Restore parameters and streams of the vehicle."""
        for name, (kind, value) in self._changed_params.items():
            self.write_param(name, kind, value)
        for message_id in self._streams:
            self.command(mav.MAV_CMD_SET_MESSAGE_INTERVAL, message_id, 0)


def velocity_target(
    vx: float = 0.0,
    vy: float = 0.0,
    vz: float = 0.0,
    yaw_rate_deg: float = 0.0,
    frame: int = mav.MAV_FRAME_LOCAL_NED,
) -> Any:
    """Return a setpoint of only a velocity in m/s and a yaw rate in deg/s."""
    motion = (0, 0, 0, vx, vy, vz, 0, 0, 0, 0, math.radians(yaw_rate_deg))
    return mav.MAVLink_set_position_target_local_ned_message(0, 1, 1, frame, VELOCITY_MASK, *motion)


def named(messages: list[Any], name: str) -> list[Any]:
    return [message for message in messages if message.get_type() == name]


def last(messages: list[Any], name: str) -> Any:
    return named(messages, name)[-1]


def texts_in(messages: list[Any]) -> list[str]:
    """Return the status texts, one of at most 50 characters a message."""
    return [message.text for message in named(messages, "STATUSTEXT")]


def rate_hz(messages: list[Any], heard_s: float) -> float:
    """Return the rate of messages by their own stamps: a busy computer delays their arrival.

    Messages without a stamp were heard for ``heard_s``.
    """
    first, newest = messages[0], messages[-1]
    if hasattr(first, "time_usec"):
        heard_s = (newest.time_usec - first.time_usec) / 1e6
    elif hasattr(first, "time_boot_ms"):
        heard_s = (newest.time_boot_ms - first.time_boot_ms) / 1e3
    return (len(messages) - 1) / heard_s


def is_armed(heartbeat: Any) -> bool:
    return bool(heartbeat.base_mode & mav.MAV_MODE_FLAG_SAFETY_ARMED)
