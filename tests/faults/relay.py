"""Relay on loopback between the vehicle and the bridge, which records and breaks the link."""

import math
import select
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from itertools import count, islice
from pathlib import Path
from typing import Any, NamedTuple

from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as dialect

from faults.link import LOOPBACK, Carrier, FaultyLink, LinkFaults
from faults.props import Worker
from faults.record import DITHER_US, NEUTRAL_US
from sitl.clock import NS_PER_MS, NS_PER_S, Clock

Message = Any  # a pymavlink message (the library has no types)
FOREVER_NS = 1 << 62
PILOTS_STATION = 42
"""System id of a ground station other than the bridge, which has 255."""
BRIDGE = 255
VEHICLE = (1, 1)
COPTER_MODES = {"STABILIZE": 0, "ALT_HOLD": 2, "LOITER": 5, "RTL": 6, "LAND": 9, "BRAKE": 17}
PX4_MODES = {
    "ALTCTL": (2, 0),
    "POSCTL": (3, 0),
    "AUTO.LOITER": (4, 3),
    "AUTO.RTL": (4, 5),
    "AUTO.LAND": (4, 6),
    "STABILIZED": (7, 0),
}
"""Main mode and sub-mode of PX4's ``custom_mode``, as MAV_CMD_DO_SET_MODE takes them."""
FORCE = 21196
"""Parameter with which MAV_CMD_COMPONENT_ARM_DISARM disarms in the air."""
UNREADABLE = ("BAD_DATA", "UNKNOWN")
"""Types of messages that pymavlink's dialect lacks, such as PX4's CURRENT_MODE and EVENT."""
IGNORED_US = 65535
NEUTRAL_Z = 500
Rewrite = Callable[[Message], bool]
"""Changes a message of the vehicle in place; False drops it."""


class Override(NamedTuple):
    """The first four channels of one RC_CHANNELS_OVERRIDE [us]."""

    roll: int
    pitch: int
    throttle: int
    yaw: int


class Sent(NamedTuple):
    """A message of the bridge on arrival at the relay, before any fault."""

    at_ns: int
    message: Message

    @property
    def name(self) -> str:
        return self.message.get_type()

    @property
    def is_command(self) -> bool:
        """True for sticks of the policy or neutral ones; False for a release."""
        return self.override is not None and any(self.override)

    @property
    def asks_mode(self) -> bool:
        is_command = self.name in ("COMMAND_LONG", "COMMAND_INT")
        return self.name == "SET_MODE" or (
            is_command and self.message.command == dialect.MAV_CMD_DO_SET_MODE
        )

    @property
    def holds(self) -> bool:
        """True for sticks in any message, also neutral ones; False for a release."""
        return self.is_command or self.name == "MANUAL_CONTROL"

    @property
    def override(self) -> Override | None:
        """Sticks of an RC_CHANNELS_OVERRIDE, or None."""
        if self.name != "RC_CHANNELS_OVERRIDE":
            return None
        return Override(*(getattr(self.message, f"chan{k}_raw") for k in range(1, 5)))

    @property
    def steers(self) -> bool:
        """True for any message of sticks."""
        return self.name in ("RC_CHANNELS_OVERRIDE", "MANUAL_CONTROL")

    @property
    def climbs(self) -> bool:
        """True if the throttle is above the middle, as only a policy's is."""
        if (sticks := self.override) is not None:
            return NEUTRAL_US[2] < sticks.throttle < IGNORED_US
        return self.name == "MANUAL_CONTROL" and self.message.z > NEUTRAL_Z

    @property
    def leans(self) -> bool:
        """True if it steers sideways, forward or around, as only a policy does."""
        if (sticks := self.override) is not None:
            turned = (sticks.roll, sticks.pitch, sticks.yaw)
            return any(us not in (0, IGNORED_US) and abs(us - 1500) > DITHER_US for us in turned)
        return self.name == "MANUAL_CONTROL" and self._most_turned > DITHER_US

    @property
    def is_within_limits(self) -> bool:
        """True if no stick exceeds the limits of its message or of a transmitter."""
        if (sticks := self.override) is not None:
            return all(us in (0, IGNORED_US) or 1000 <= us <= 2000 for us in sticks)
        if self.name == "MANUAL_CONTROL":
            return self._most_turned <= 1000 and 0 <= self.message.z <= 1000
        return True

    @property
    def _most_turned(self) -> int:
        return max(abs(self.message.x), abs(self.message.y), abs(self.message.r))


class _Way:
    """One direction of the link. New faults do not affect packets in flight."""

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


class Relay(Worker):
    """Passes packets between the vehicle and the bridge, and keeps the bridge's messages."""

    def __init__(self, carrier: Carrier, clock: Clock) -> None:
        """``carrier`` leads to the bridge; the relay closes it."""
        super().__init__("relay")
        self.carrier = carrier
        self._clock = clock
        self._vehicle: tuple[str, int] | None = None
        self._to_vehicle, self._to_bridge = _Way(), _Way()
        self._rewrites: tuple[Rewrite, ...] = ()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((LOOPBACK, 0))
        self._socket.setblocking(False)
        self._mav = _parser(BRIDGE)
        self._vehicles = _parser(VEHICLE[0])
        self._station = dialect.MAVLink(None, srcSystem=PILOTS_STATION, srcComponent=190)
        self._joystick = dialect.MAVLink(None, srcSystem=BRIDGE, srcComponent=190)
        self._news = threading.Condition()
        self.sent: list[Sent] = []
        self.has_flown = threading.Event()
        self.has_heard = threading.Event()
        """Set once the vehicle has sent something, so that its address is known."""
        self.longest_silence_ms = 0.0
        """Longest time in flight without a packet of the vehicle, before any fault of the link and
        before a reboot."""
        self.has_rebooted = False
        self._heard_ns = 0
        self.port: int = self._socket.getsockname()[1]

    def __exit__(self, *_: object) -> None:
        super().__exit__()
        self._socket.close()
        self.carrier.close()

    @property
    def overrides(self) -> list[Override]:
        """All overrides so far, releases included."""
        return [sticks for sent in self.sent if (sticks := sent.override) is not None]

    def forget(self) -> None:
        """Forget the flight so far, because another begins."""
        with self._news:
            self.sent.clear()
            self.has_flown.clear()

    def newest_steering(self, rows: int) -> list[Sent]:
        """Return up to ``rows`` of the newest messages of sticks, newest last."""
        newest = islice((sent for sent in reversed(self.sent) if sent.steers), rows)
        return list(newest)[::-1]

    def is_leaning(self, rows: int) -> bool:
        """True if the newest ``rows`` messages of sticks all lean."""
        steering = self.newest_steering(rows)
        return len(steering) == rows and all(sent.leans for sent in steering)

    def impair(self, way: str, faults: LinkFaults) -> int:
        """Change ``to_vehicle``, ``to_bridge`` or ``both`` from now on; return the time."""
        at_ns = self._clock.now_ns()
        ways = {"to_vehicle": self._to_vehicle, "to_bridge": self._to_bridge}
        for one in ways.values() if way == "both" else [ways[way]]:
            one.impair(faults)
        return at_ns

    def rewrite(self, change: Rewrite) -> int:
        """Also pass every message of the vehicle through ``change``; return the time."""
        self._rewrites = (*self._rewrites, change)
        return self._clock.now_ns()

    def inject(self, message: Message, station: Message = None) -> int:
        """Send a message to the vehicle as another ground station; return the time."""
        if self._vehicle is None:
            raise ValueError("the vehicle has not been heard yet")
        at_ns = self._clock.now_ns()
        self._socket.sendto(message.pack(station or self._station), self._vehicle)
        return at_ns

    def move_joystick(self, sticks: Override, *, is_manual: bool = False) -> int:
        """Send sticks of another program with the bridge's own system id; return the time.

        ``is_manual``: as MANUAL_CONTROL, which PX4 takes, instead of overrides.
        """
        channels = (*sticks, *[IGNORED_US] * 4)
        message: Message = dialect.MAVLink_rc_channels_override_message(*VEHICLE, *channels)
        if is_manual:
            roll, pitch, throttle, yaw = (2 * (us - 1500) for us in sticks)
            message = dialect.MAVLink_manual_control_message(
                VEHICLE[0], -pitch, roll, NEUTRAL_Z + throttle // 2, yaw, 0
            )
        return self.inject(message, self._joystick)

    def command(self, number: int, *params: float) -> int:
        """Send a command to the vehicle as another ground station; return the time."""
        padded = (*params, *[0.0] * (7 - len(params)))
        return self.inject(dialect.MAVLink_command_long_message(*VEHICLE, number, 0, *padded))

    def set_mode(self, mode: str) -> int:
        custom = PX4_MODES.get(mode, ()) or (COPTER_MODES[mode],)
        return self.command(dialect.MAV_CMD_DO_SET_MODE, 1, *custom)

    def arm(self) -> int:
        return self.command(dialect.MAV_CMD_COMPONENT_ARM_DISARM, 1)

    def disarm(self) -> int:
        """Stop the motors as a pilot at another station, even in the air."""
        return self.command(dialect.MAV_CMD_COMPONENT_ARM_DISARM, 0, FORCE)

    def wait_until(self, condition: Callable[[], bool], timeout_s: float = 60.0) -> bool:
        with self._news:
            return self._news.wait_for(condition, timeout_s)

    def _run(self) -> None:
        while not self._stop.is_set():
            now_ns = self._clock.now_ns()
            due_ns = min(self._to_vehicle.due_ns, self._to_bridge.due_ns)
            longest_s = min(max((due_ns - now_ns) / NS_PER_S, 1e-4), self.carrier.wait_s)
            select.select([self._socket.fileno(), *self.carrier.descriptors()], [], [], longest_s)
            now_ns = self._clock.now_ns()
            messages = self._take_bridges(now_ns)
            self._take_vehicles(now_ns)
            self._deliver(now_ns)
            if messages:
                self._record(messages, now_ns)

    def _take_bridges(self, now_ns: int) -> list[Message]:
        """Pass the bridge's data on to the vehicle; those of a stream as complete packets."""
        taken: list[Message] = []
        for data in self.carrier.receive():
            messages = self._mav.parse_buffer(data) or []
            whole = [message.get_msgbuf() for message in messages]
            for packet in whole if self.carrier.is_stream else [data]:
                self._to_vehicle.pass_on(bytes(packet), now_ns)
            taken += messages
        return taken

    def _take_vehicles(self, now_ns: int) -> None:
        try:
            data, self._vehicle = self._socket.recvfrom(65536)
        except (BlockingIOError, ConnectionError):
            return
        if self.has_flown.is_set() and not self.has_rebooted:
            silence_ms = (now_ns - self._heard_ns) / NS_PER_MS
            self.longest_silence_ms = max(self.longest_silence_ms, silence_ms)
        self._heard_ns = now_ns
        self.has_heard.set()
        if data := self._rewritten(data):
            self._to_bridge.pass_on(data, now_ns)

    def _rewritten(self, data: bytes) -> bytes:
        changes = self._rewrites
        if not changes:
            return data
        kept = bytearray()
        for message in self._vehicles.parse_buffer(data) or ():
            if message.get_type().startswith(UNREADABLE):
                kept += message.get_msgbuf()
            elif all(change(message) for change in changes):
                self._vehicles.seq = message.get_seq()
                self._vehicles.srcComponent = message.get_srcComponent()
                kept += message.pack(self._vehicles)
        return bytes(kept)

    def _deliver(self, now_ns: int) -> None:
        for packet in self._to_bridge.arrived(now_ns):
            self.carrier.send(packet)
        for packet in self._to_vehicle.arrived(now_ns):
            if self._vehicle is not None:
                with suppress(BlockingIOError, ConnectionError):
                    self._socket.sendto(packet, self._vehicle)

    def _record(self, messages: list[Message], now_ns: int) -> None:
        with self._news:
            for message in messages:
                sent = Sent(now_ns, message)
                self.sent.append(sent)
                if sent.climbs:
                    self.has_flown.set()
            self._news.notify_all()


def _parser(system: int) -> Message:
    parser = dialect.MAVLink(None, srcSystem=system)
    parser.robust_parsing = True
    return parser


def set_fields(message: Message, **values: float) -> None:
    """Change fields of a received message, so that packing it again sends the new values."""
    for name, value in values.items():
        setattr(message, name, value if math.isnan(value) else type(getattr(message, name))(value))


def logged_overrides(path: Path) -> Iterator[Override]:
    """Yield the first four channels of every RC_CHANNELS_OVERRIDE in a telemetry log."""
    log = mavutil.mavlogfile(str(path))
    while (message := log.recv_match(type="RC_CHANNELS_OVERRIDE")) is not None:
        yield Override(*(getattr(message, f"chan{k}_raw") for k in range(1, 5)))
    log.f.close()
