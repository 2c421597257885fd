"""A relay on loopback between the vehicle and the bridge: it records, and it breaks the link."""

import socket
import threading
import time
from collections.abc import Callable
from itertools import count
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as dialect

from sitl.faults import FaultyLink, LinkFaults

NS_PER_S = 1_000_000_000
FOREVER_NS = 1 << 62
PILOTS_STATION = 42
"""System id of another ground station than the bridge's 255."""
BRIDGE = 255
VEHICLE = (1, 1)
COPTER_MODES = {"STABILIZE": 0, "ALT_HOLD": 2, "LOITER": 5}
FORCE = 21196
"""MAV_CMD_COMPONENT_ARM_DISARM disarms in the air with this."""


class Override(NamedTuple):
    """The first four channels of one RC_CHANNELS_OVERRIDE, in us."""

    roll: int
    pitch: int
    throttle: int
    yaw: int


class Sent(NamedTuple):
    """A message of the bridge as it came to the relay, before any fault."""

    at_ns: int
    message: Any

    @property
    def name(self) -> str:
        name: str = self.message.get_type()
        return name

    @property
    def is_command(self) -> bool:
        """Sticks of the policy, or neutral; no release."""
        return self.override is not None and any(self.override)

    @property
    def override(self) -> Override | None:
        if self.name != "RC_CHANNELS_OVERRIDE":
            return None
        return Override(*(getattr(self.message, f"chan{k}_raw") for k in range(1, 5)))


class _Way:
    """One direction; a packet that is under way arrives whatever happens to later ones."""

    def __init__(self) -> None:
        self._seeds = count()
        self._links = [FaultyLink(LinkFaults(), next(self._seeds))]

    def impair(self, faults: LinkFaults) -> None:
        self._links = [*self._links, FaultyLink(faults, next(self._seeds))]

    def pass_on(self, packet: bytes, now_ns: int) -> None:
        self._links[-1].send(packet, now_ns)

    def arrived(self, now_ns: int) -> list[bytes]:
        return [packet for link in self._links for packet in link.receive(now_ns)]

    @property
    def due_ns(self) -> int:
        return min((link.due_ns or FOREVER_NS for link in self._links), default=FOREVER_NS)


class Relay:
    """Passes datagrams between the vehicle and the bridge, and keeps what the bridge sends."""

    def __init__(self, bridge_port: int) -> None:
        self.bridge_port = bridge_port
        self._bridge = ("127.0.0.1", bridge_port)
        self._vehicle: tuple[str, int] | None = None
        self._to_vehicle, self._to_bridge = _Way(), _Way()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._mav = dialect.MAVLink(None)
        self._mav.robust_parsing = True
        self._station = dialect.MAVLink(None, srcSystem=PILOTS_STATION, srcComponent=190)
        self._joystick = dialect.MAVLink(None, srcSystem=BRIDGE, srcComponent=190)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="relay")
        self._news = threading.Condition()
        self.sent: list[Sent] = []
        self.overrides: list[Override] = []
        self.has_flown = threading.Event()
        self.port: int = self._socket.getsockname()[1]

    def __enter__(self) -> "Relay":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(5)
        self._socket.close()

    def forget(self) -> None:
        """Forget the flight so far: another one begins."""
        with self._news:
            self.sent.clear()
            self.overrides.clear()
            self.has_flown.clear()

    def impair(
        self, *, to_vehicle: LinkFaults | None = None, to_bridge: LinkFaults | None = None
    ) -> int:
        """Change the link from now on; returns the moment. None leaves a direction as it is."""
        at_ns = time.monotonic_ns()
        if to_vehicle is not None:
            self._to_vehicle.impair(to_vehicle)
        if to_bridge is not None:
            self._to_bridge.impair(to_bridge)
        return at_ns

    def inject(self, message: Any, station: Any = None) -> int:
        """Send a message to the vehicle as another ground station; returns the moment."""
        assert self._vehicle is not None
        at_ns = time.monotonic_ns()
        self._socket.sendto(message.pack(station or self._station), self._vehicle)
        return at_ns

    def move_joystick(self, sticks: Override) -> int:
        """Another program overrides with the bridge's own system id; returns the moment."""
        channels = (*sticks, *[65535] * 4)
        message = dialect.MAVLink_rc_channels_override_message(*VEHICLE, *channels)
        return self.inject(message, self._joystick)

    def command(self, number: int, *params: float) -> int:
        """Send a command to the vehicle as another ground station; returns the moment."""
        padded = (*params, *[0.0] * (7 - len(params)))
        return self.inject(dialect.MAVLink_command_long_message(*VEHICLE, number, 0, *padded))

    def set_mode(self, mode: str) -> int:
        """The pilot changes the mode at another station."""
        return self.command(dialect.MAV_CMD_DO_SET_MODE, 1, COPTER_MODES[mode])

    def arm(self) -> int:
        """The pilot arms at another station."""
        return self.command(dialect.MAV_CMD_COMPONENT_ARM_DISARM, 1)

    def disarm(self) -> int:
        """The pilot stops the motors at another station, in the air too."""
        return self.command(dialect.MAV_CMD_COMPONENT_ARM_DISARM, 0, FORCE)

    def wait_until(self, condition: Callable[[], bool], timeout_s: float = 60.0) -> bool:
        """Wait for something to become true of what the bridge has sent."""
        with self._news:
            return self._news.wait_for(condition, timeout_s)

    def sent_since(self, at_ns: int, name: str) -> list[Sent]:
        """Messages of this name that came after a moment."""
        return [sent for sent in self.sent if sent.at_ns > at_ns and sent.name == name]

    def _run(self) -> None:
        while not self._stop.is_set():
            now_ns = time.monotonic_ns()
            due_ns = min(self._to_vehicle.due_ns, self._to_bridge.due_ns)
            self._socket.settimeout(min(max((due_ns - now_ns) / NS_PER_S, 1e-4), 0.2))
            try:
                data, sender = self._socket.recvfrom(65536)
            except (TimeoutError, ConnectionError):
                data, sender = b"", None
            now_ns = time.monotonic_ns()
            if sender == self._bridge:
                self._to_vehicle.pass_on(data, now_ns)
            elif sender is not None:
                self._vehicle = sender
                self._to_bridge.pass_on(data, now_ns)
            self._deliver(now_ns)
            if sender == self._bridge:
                self._record(data, now_ns)

    def _deliver(self, now_ns: int) -> None:
        for packet in self._to_bridge.arrived(now_ns):
            self._socket.sendto(packet, self._bridge)
        for packet in self._to_vehicle.arrived(now_ns):
            if self._vehicle is not None:
                self._socket.sendto(packet, self._vehicle)

    def _record(self, data: bytes, now_ns: int) -> None:
        with self._news:
            for message in self._mav.parse_buffer(data) or ():
                sent = Sent(now_ns, message)
                self.sent.append(sent)
                if (sticks := sent.override) is not None:
                    self.overrides.append(sticks)
                    if sticks.throttle > 1500:  # the policy climbs
                        self.has_flown.set()
            self._news.notify_all()
