"""Surroundings of a flight in memory: a link with faults, a readable channel, no camera."""

from collections import deque
from collections.abc import Iterator

import numpy as np

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.records import FeatureFrame
from mavbridge.flight.feature_cache import FeatureCache
from mavbridge.guard.wire import FromGuard, decode_from_guard
from mavbridge.mavlink.transport.connection import Address, Received, TransportDownError
from mavbridge.simulation.clock import SteppedClock
from mavbridge.simulation.network import VEHICLE, DelayedChannel, MemoryPort, MemoryTransport
from mavbridge.simulation.world import VehicleStepper
from sitl.simulated_vehicle import SimulatedVehicle
from sitl.vehicle.config import VehicleConfig

MS = NS_PER_MS
DELAY_NS = NS_PER_MS * 3 // 10


class Direction(DelayedChannel):
    """One direction of the link, whose faults can be changed in flight."""

    def __init__(self, clock: SteppedClock) -> None:
        self.is_silent = False
        self.bytes_per_s = 0.0
        """Bandwidth; packets behind half a second of others are dropped. 0: unlimited."""
        self._free_ns = 0
        self.sent: list[tuple[int, bytes]] = []
        """Every datagram with its time, including lost ones."""
        self._world = clock
        super().__init__(clock, self._delays_ns())

    def _delays_ns(self) -> Iterator[int]:
        while True:
            yield DELAY_NS + max(self._free_ns - self._world.now_ns(), 0)

    def send(self, data: bytes) -> None:
        now_ns = self._world.now_ns()
        self.sent.append((now_ns, data))
        if self.is_silent:
            return
        if self.bytes_per_s:
            if self._free_ns - now_ns > 500 * MS:
                return
            self._free_ns = max(self._free_ns, now_ns)
            self._free_ns += round(len(data) / self.bytes_per_s * NS_PER_S)
        super().send(data)


class Network(MemoryTransport):
    """The bridge's end of the link, which other addresses can write to, too."""

    def __init__(self, clock: SteppedClock, to_vehicle: Direction, from_vehicle: Direction) -> None:
        self._clock = clock
        super().__init__(to_vehicle=to_vehicle, from_vehicle=from_vehicle)
        self._to_vehicle: Direction = to_vehicle
        self.strangers: deque[Received] = deque()
        self.received: list[Received] = []
        """Everything from the vehicle, as a recording holds it."""
        self.is_down = False
        """True if the port is gone."""

    def open(self) -> None:
        if self.is_down:
            raise TransportDownError("no such port")

    def fileno(self) -> int | None:
        """Return a number, so that the guard prepares its last words."""
        return 7

    def send(self, data: bytes, peer: Address | None = None) -> bool:
        self.open()
        if peer in (None, VEHICLE):
            return super().send(data, peer)
        self._to_vehicle.sent.append((self._clock.now_ns(), data))  # to a stranger
        return True

    def drain(self) -> Iterator[Received]:
        self.open()
        for received in super().drain():
            self.received.append(received)
            yield received
        while self.strangers:
            yield self.strangers.popleft()


class LinkedVehicle:
    """A simulated vehicle on a stepped clock, and the bridge's end of its link.

    Another station has a second link, whose answers nobody reads.
    """

    def __init__(self, config: VehicleConfig, params: dict[str, float] | None = None) -> None:
        self.clock = SteppedClock()
        self.vehicle = SimulatedVehicle(links=2, boot_ns=self.clock.now_ns(), config=config)
        for name, value in (params or {}).items():
            assert self.vehicle.params.set(name, value), name
        self.up, self.down = Direction(self.clock), Direction(self.clock)
        self.network = Network(self.clock, self.up, self.down)
        ends = {"to_vehicle": self.up, "from_vehicle": self.down}
        stepper = VehicleStepper(self.clock, self.vehicle, self.clock.now_ns(), **ends)
        stepper.watchers.append(self._after_step)

    def _after_step(self) -> None:
        """Called after each step of the vehicle."""
        self.vehicle.take_outgoing(1)


class FlightPort(MemoryPort):
    """The guard's end of the channel to the flight process; keeps every report."""

    def __init__(self, **channels: DelayedChannel) -> None:
        super().__init__(**channels)
        self.reports: list[FromGuard] = []

    def send(self, message: bytes, fd: int | None = None) -> bool:
        self.reports.append(decode_from_guard(message))
        return super().send(message, fd)


class FreshFeatures(FeatureCache):
    """Camera without faults."""

    def __init__(self, clock: SteppedClock) -> None:
        super().__init__()
        self._clock = clock

    def latest(self) -> FeatureFrame:
        captured_ns = self._clock.now_ns() - 20 * MS
        return FeatureFrame(
            frame_id=captured_ns // MS,
            captured_ns=captured_ns,
            ready_ns=captured_ns,
            value=np.zeros((1, 1), np.float32),
        )
