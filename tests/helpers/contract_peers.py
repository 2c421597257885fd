"""Peers of the contract suite and what talks to them: a simulated vehicle here, or one by UDP."""

import socket
from collections.abc import Callable
from typing import Any, Protocol

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.clock import NS_PER_MS, NS_PER_S, Clock
from sitl.simulated_vehicle import SimulatedVehicle
from sitl.vehicle.config import VehicleConfig

GCS = 255
TICK_NS = 5 * NS_PER_MS


class Peer(Protocol):
    """A flight controller at the other end of a byte link."""

    def now_ns(self) -> int: ...

    def send(self, data: bytes) -> None: ...

    def advance(self, duration_ns: int) -> bytes:
        """Let time pass; the bytes that came meanwhile."""
        ...


class MockPeer:
    """The vehicle of ``sitl`` in this process; time passes only here."""

    def __init__(self, config: VehicleConfig) -> None:
        self._now_ns = 0
        self.vehicle = SimulatedVehicle(links=1, boot_ns=0, config=config)

    def now_ns(self) -> int:
        return self._now_ns

    def send(self, data: bytes) -> None:
        self.vehicle.receive(0, data, self._now_ns)

    def advance(self, duration_ns: int) -> bytes:
        end_ns = self._now_ns + duration_ns
        taken = b""
        while self._now_ns < end_ns:
            self._now_ns = min(end_ns, self._now_ns + 2_500_000)
            self.vehicle.step(self._now_ns)
            taken += self.vehicle.take_outgoing(0)
        return taken


class UdpPeer:
    """A flight controller that sends to a UDP port of ours."""

    def __init__(self, address: tuple[str, int]) -> None:
        self._clock = Clock()
        self._peer: tuple[str, int] | None = None
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(address)
        self._socket.setblocking(False)

    def now_ns(self) -> int:
        return self._clock.now_ns()

    def send(self, data: bytes) -> None:
        if self._peer is not None:
            self._socket.sendto(data, self._peer)

    def advance(self, duration_ns: int) -> bytes:
        """Reads every few milliseconds: a second of telemetry is more than a socket holds."""
        end_ns = self._clock.now_ns() + duration_ns
        taken = b""
        while (now_ns := self._clock.now_ns()) < end_ns:
            self._clock.sleep_until_ns(min(end_ns, now_ns + TICK_NS))
            taken += self._read()
        return taken

    def _read(self) -> bytes:
        taken = b""
        while True:
            try:
                data, self._peer = self._socket.recvfrom(65535)
            except BlockingIOError:
                return taken
            taken += data

    def close(self) -> None:
        self._socket.close()


class Companion:
    """A ground station or companion computer: frames messages, waits for answers."""

    def __init__(self, peer: Peer) -> None:
        self.peer = peer
        self._mav = mav.MAVLink(None, srcComponent=191)
        self._mav.robust_parsing = True
        self._changed_params: dict[str, float] = {}

    def send(self, message: Any, *, system_id: int = GCS) -> None:
        self._mav.srcSystem = system_id
        self.peer.send(message.pack(self._mav))

    def advance(self, seconds: float) -> list[Any]:
        data = self.peer.advance(round(seconds * NS_PER_S))
        return self._mav.parse_buffer(data) or []

    def wait(
        self, name: str, timeout_s: float = 3.0, where: Callable[[Any], bool] = lambda _: True
    ) -> Any:
        """The next message of that name; the test fails without one."""
        end_ns = self.peer.now_ns() + round(timeout_s * NS_PER_S)
        while self.peer.now_ns() < end_ns:
            for message in self.advance(TICK_NS / NS_PER_S):
                if message.get_type() == name and where(message):
                    return message
        return pytest.fail(f"no such {name} within {timeout_s} s")

    def command(self, number: int, *params: float, system_id: int = GCS) -> int:
        """Send a command; the result in its ack."""
        padded = (*params, *[0.0] * (7 - len(params)))
        self.send(mav.MAVLink_command_long_message(1, 1, number, 0, *padded), system_id=system_id)
        ack = self.wait("COMMAND_ACK", where=lambda m: m.command == number)
        return int(ack.result)

    def stream(self, message_id: int, rate_hz: float) -> int:
        return self.command(mav.MAV_CMD_SET_MESSAGE_INTERVAL, message_id, int(1e6 / rate_hz))

    def set_mode(self, number: int) -> int:
        return self.command(mav.MAV_CMD_DO_SET_MODE, 1, number)

    def arm(self) -> int:
        return self.command(mav.MAV_CMD_COMPONENT_ARM_DISARM, 1)

    def override(self, *channels_us: int, system_id: int = GCS, target: int = 1) -> None:
        """RC_CHANNELS_OVERRIDE; channels 1-8 that are not given are ignored."""
        primary = (*channels_us, *[65535] * (8 - len(channels_us)))[:8]
        aux = (*channels_us[8:], *[0] * (10 - len(channels_us[8:])))
        message = mav.MAVLink_rc_channels_override_message(target, 0, *primary, *aux)
        self.send(message, system_id=system_id)

    def hold(
        self,
        seconds: float,
        *,
        roll: int = 1500,
        pitch: int = 1500,
        thr: int = 1500,
        yaw: int = 1500,
    ) -> list[Any]:
        """Hold the sticks by overrides at 50 Hz; what came in meanwhile."""
        messages = []
        for _ in range(round(seconds * 50.0)):
            self.override(roll, pitch, thr, yaw)
            messages += self.advance(0.02)
        return messages

    def channels(self) -> tuple[int, ...]:
        """Channels that the vehicle uses; needs RC_CHANNELS to be streamed."""
        message = self.wait("RC_CHANNELS")
        return tuple(getattr(message, f"chan{n}_raw") for n in range(1, 17))

    def get_param(self, name: str) -> float:
        self.send(mav.MAVLink_param_request_read_message(1, 1, name.encode(), -1))
        return float(self.wait("PARAM_VALUE", where=lambda m: m.param_id == name).param_value)

    def set_param(self, name: str, value: float) -> float:
        self._changed_params.setdefault(name, self.get_param(name))
        return self._write_param(name, value)

    def get_ready(self, mode: int) -> None:
        """Wait until arming is possible, with throttle down and the rest centred; do not arm."""
        for _ in range(60):
            self.send(mav.MAVLink_command_long_message(1, 1, 512, 0, 1, 0, 0, 0, 0, 0, 0))
            # A vehicle that has just booted may lose the request.
            health = [
                m.onboard_control_sensors_health
                for m in self.hold(1.0, thr=1000)
                if m.get_type() == "SYS_STATUS"
            ]
            if health and health[-1] & mav.MAV_SYS_STATUS_PREARM_CHECK:
                break
        assert self.set_mode(mode) == mav.MAV_RESULT_ACCEPTED

    def restore(self) -> None:
        """Leave the vehicle on the ground with the parameters that it had."""
        self.command(mav.MAV_CMD_COMPONENT_ARM_DISARM, 0, 21196)
        for name, value in self._changed_params.items():
            self._write_param(name, value)
        self.override(*[0] * 8)
        self.advance(0.1)

    def _write_param(self, name: str, value: float) -> float:
        message = mav.MAVLink_param_set_message(
            1, 1, name.encode(), value, mav.MAV_PARAM_TYPE_REAL32
        )
        self.send(message)
        return float(self.wait("PARAM_VALUE", where=lambda m: m.param_id == name).param_value)
