"""Scripted faults: a lossy link, frozen sensors, a reboot; a seed always gives the same faults."""

import heapq
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from sitl.clock import NS_PER_MS, NS_PER_S
from sitl.simulated_vehicle import SimulatedVehicle


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkFaults:
    """Probabilities per packet, each in [0, 1], and times."""

    loss: float = 0.0
    duplicate: float = 0.0
    corrupt: float = 0.0  # one byte is changed
    reorder: float = 0.0  # the packet is held back by ``reorder_ms``, so later ones overtake it
    reorder_ms: float = 20.0
    delay_ms: float = 0.0
    silence_ns: tuple[int, int] | None = None
    """From and until (not included) on the caller's clock: what is sent meanwhile is lost."""


class FaultyLink:
    """One direction of a link: packets in, the surviving ones out when they are due."""

    def __init__(self, faults: LinkFaults, seed: int) -> None:
        self._faults = faults
        self._random = np.random.Generator(np.random.PCG64(seed))
        self._in_flight: list[tuple[int, int, bytes]] = []
        self._sent = 0

    def send(self, packet: bytes, now_ns: int) -> None:
        """Put a packet on the link."""
        silence_ns = self._faults.silence_ns
        if silence_ns is not None and silence_ns[0] <= now_ns < silence_ns[1]:
            return
        if self._happens(self._faults.loss):
            return
        for _ in range(2 if self._happens(self._faults.duplicate) else 1):
            delay_ms = self._faults.delay_ms
            if self._happens(self._faults.reorder):
                delay_ms += self._faults.reorder_ms
            due_ns = now_ns + round(delay_ms * NS_PER_MS)
            heapq.heappush(self._in_flight, (due_ns, self._sent, self._maybe_corrupt(packet)))
            self._sent += 1

    @property
    def due_ns(self) -> int | None:
        """When the next packet arrives; None while none is on its way."""
        return self._in_flight[0][0] if self._in_flight else None

    def receive(self, now_ns: int) -> list[bytes]:
        """Packets that have arrived by now, in order of arrival."""
        arrived = []
        while self._in_flight and self._in_flight[0][0] <= now_ns:
            arrived.append(heapq.heappop(self._in_flight)[2])
        return arrived

    def _maybe_corrupt(self, packet: bytes) -> bytes:
        if not packet or not self._happens(self._faults.corrupt):
            return packet
        at = int(self._random.integers(len(packet)))
        flipped = packet[at] ^ int(self._random.integers(1, 256))
        return packet[:at] + bytes([flipped]) + packet[at + 1 :]

    def _happens(self, probability: float) -> bool:
        return probability > 0.0 and float(self._random.random()) < probability


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorFreeze:
    """Telemetry and control keep the last state for a while; the vehicle flies on blindly."""

    start_s: float
    end_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Reboot:
    """The autopilot restarts: time_boot_ms falls back to 0."""

    at_s: float


class VehicleFaults:
    """A script of vehicle faults; times are seconds since ``start_ns``."""

    def __init__(self, script: Iterable[SensorFreeze | Reboot], start_ns: int) -> None:
        script = tuple(script)
        self._start_ns = start_ns
        self._freezes = [fault for fault in script if isinstance(fault, SensorFreeze)]
        self._reboots_s = sorted(fault.at_s for fault in script if isinstance(fault, Reboot))

    def apply(self, vehicle: SimulatedVehicle, now_ns: int) -> None:
        """Apply the faults of this moment; call it before each step."""
        t_s = (now_ns - self._start_ns) / NS_PER_S
        while self._reboots_s and t_s >= self._reboots_s[0]:
            self._reboots_s.pop(0)
            vehicle.reboot()
        vehicle.ap.sensors_frozen = any(f.start_s <= t_s < f.end_s for f in self._freezes)
